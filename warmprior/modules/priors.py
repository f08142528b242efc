"""The paper's source distributions: the usual Gaussian one, WP-Past and WP-Preview."""

from __future__ import annotations

import torch
from torch import Tensor

from warmprior.modules.prior import Prior

__all__ = ["GaussianPrior", "PastPrior", "PreviewPrior"]


def _all_cold(like: Tensor) -> tuple[Tensor, Tensor]:
    return torch.zeros_like(like), torch.zeros_like(like[..., :1], dtype=torch.bool)


class GaussianPrior(Prior):
    """The usual standard normal source: nothing is ever warm. The baseline of every comparison.

    See Also:
        - :class:`~warmprior.PastPrior`: starts from what was executed last.
        - :class:`~warmprior.PreviewPrior`: starts from the policy's own forecast.

    Examples:
        >>> import torch
        >>> prior = GaussianPrior(8)
        >>> loc, warm = prior.training_mean(
        ...     torch.ones(1, 8, 2), torch.ones(1, 8, dtype=torch.bool), torch.ones(1, 8, 2))
        >>> bool(warm.any())
        False
    """

    name = "gaussian"
    label = "Base"
    color = "#7f7f7f"
    ever_warm = False

    def training_mean(
        self, history: Tensor, history_valid: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        """All cold."""
        return _all_cold(target)

    def next_mean(
        self, loc: Tensor, chunk: Tensor, executed_steps: Tensor, elapsed_steps: Tensor
    ) -> tuple[Tensor, Tensor]:
        """All cold."""
        return _all_cold(chunk)


class PastPrior(Prior):
    r"""WP-Past: the mean is the last ``H`` executed actions, ``sigma`` 0.5 by default (Equation 2).

    In training :math:`\mu_\tau = a^{data}[i-H+\tau]` if the whole window lies inside the episode, and
    nothing is warm otherwise. At decisions the mean is the last ``H`` actions executed in the episode,
    however many of each chunk were executed, and nothing is warm before ``H`` actions were executed.

    See Also:
        - :class:`~warmprior.PreviewPrior`: starts from the policy's own forecast instead.
        - :class:`~warmprior.HistoryPrior`: lets the network see the last actions, with a Gaussian source.
        - :class:`~warmprior.ActionHistory`: writes the mean for the next decision in the environment.

    Examples:
        >>> import torch
        >>> prior = PastPrior(2)
        >>> loc, warm = prior.training_mean(
        ...     torch.tensor([[[1.0], [2.0]]]), torch.tensor([[True, True]]), torch.zeros(1, 2, 1))
        >>> loc.flatten().tolist(), bool(warm.all())
        ([1.0, 2.0], True)
    """

    name = "past"
    label = "WP-Past"
    color = "#1f77b4"
    default_sigma = 0.5

    def training_mean(
        self, history: Tensor, history_valid: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The dataset actions ``[i-H, i)``, if all of them lie inside the episode."""
        warm = history_valid.all(-1)[..., None, None].expand(*history.shape[:-1], 1)
        return torch.where(warm, history, 0.0), warm

    def next_mean(
        self, loc: Tensor, chunk: Tensor, executed_steps: Tensor, elapsed_steps: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The last ``H`` executed actions: ``[loc, chunk][k : k + H]``.

        Before ``H`` actions were executed nothing is warm, but ``loc`` already collects them: that is
        what makes the mean right at the first decision that has a full history.
        """
        executed = torch.cat([loc, chunk], dim=-2)
        loc = executed.gather(-2, self.positions(executed_steps, executed, self.chunk_length))
        warm = (elapsed_steps >= self.chunk_length).unsqueeze(-1)
        return loc, warm.expand(*loc.shape[:-1], 1)


class PreviewPrior(Prior):
    r"""WP-Preview: the mean is the policy's own earlier forecast of this chunk, ``sigma`` 1 by default.

    The network predicts ``P = 2H`` actions. In training the target's own first ``H`` actions stand in
    for a perfect forecast (Eq. 3); at decisions the mean is the previous prediction ``[k, k+H)``
    (Eq. 4). The second half is always cold.

    .. note::
        Algorithm 1 never shows the network a cold first half, which is what it meets at the first
        decision of every episode. ``cold_probability`` repairs that; it matters for small ``sigma``.

    See Also:
        - :class:`~warmprior.PastPrior`: starts from what was executed instead.
        - :class:`~warmprior.ActionHistory`: writes the mean for the next decision in the environment.

    Examples:
        >>> import torch
        >>> prior = PreviewPrior(2)
        >>> loc, warm = prior.next_mean(
        ...     torch.zeros(1, 4, 1), torch.arange(4.0).view(1, 4, 1),
        ...     torch.tensor([[2]]), torch.tensor([[2]]))
        >>> loc.flatten().tolist(), warm.flatten().tolist()
        ([2.0, 3.0, 0.0, 0.0], [True, True, False, False])
    """

    name = "preview"
    label = "WP-Preview"
    color = "#d95f02"
    prediction_chunks = 2

    def _first_half(self, forecast: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        loc, warm = _all_cold(like)
        loc[..., : self.chunk_length, :] = forecast
        warm[..., : self.chunk_length, :].fill_(True)
        return loc, warm

    def training_mean(
        self, history: Tensor, history_valid: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The target's own first ``H`` actions."""
        return self._first_half(target[..., : self.chunk_length, :], target)

    def next_mean(
        self, loc: Tensor, chunk: Tensor, executed_steps: Tensor, elapsed_steps: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The previous prediction ``[k, k + H)``."""
        index = self.positions(executed_steps, chunk, self.chunk_length)
        return self._first_half(chunk.gather(-2, index), chunk)
