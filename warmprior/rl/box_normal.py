"""The agent's distribution, with densities independent of the size of its box."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.modules import TanhNormal

__all__ = ["BoxTanhNormal"]


class BoxTanhNormal(TanhNormal):
    r""":class:`~torchrl.modules.TanhNormal` with log-probabilities in units of its box.

    For :math:`\Delta \in [-\delta, \delta]^n` they are those of :math:`\Delta / \delta \in [-1, 1]^n`,
    larger by :math:`n \log \delta`. With it TorchRL's own losses measure entropy as DSRL and
    :class:`~warmprior.DSRLNALoss` do, in temperatures and in the targets of critics, whatever the box:
    ``make_prior_space_actor(..., distribution_class=BoxTanhNormal)``, with
    ``SACLoss(..., target_entropy=0.0)`` as in DSRL.

    Args:
        loc: as for the parent.
        scale: as for the parent.
        kwargs (Any): as for the parent, ``low`` and ``high`` among them.

    Examples:
        >>> from warmprior import BoxTanhNormal
        >>> import torch
        >>> loc, scale = torch.zeros(2), torch.ones(2)
        >>> small = BoxTanhNormal(loc, scale, low=-0.5, high=0.5, event_dims=1)
        >>> large = BoxTanhNormal(loc, scale, low=-1.5, high=1.5, event_dims=1)
        >>> bool(torch.isclose(small.log_prob(0.1 * torch.ones(2)), large.log_prob(0.3 * torch.ones(2))))
        True
    """

    def _change_of_units(self) -> Tensor:
        half = (self.high - self.low) / 2
        return half.log().expand(self.event_shape).sum()

    def log_prob(self, value: Tensor) -> Tensor:
        """The log-density of ``value`` in units of the box."""
        return super().log_prob(value) + self._change_of_units()

    def rsample_and_log_prob(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """A draw with pathwise gradients and its log-density in units of the box."""
        sample, log_prob = super().rsample_and_log_prob(sample_shape)
        return sample, log_prob + self._change_of_units()

    def sample_and_log_prob(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """A draw without pathwise gradients and its log-density in units of the box."""
        sample, log_prob = super().sample_and_log_prob(sample_shape)
        return sample, log_prob + self._change_of_units()
