"""Residuals in source space without an agent."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from warmprior import keys
from warmprior.rl.anchor import has_anchor, residual_sigma
from warmprior.rl.decoder import PriorDecoder

__all__ = ["ResidualSampler"]

ResidualDistribution = Literal["normal", "clipped", "uniform"]


class ResidualSampler(TensorDictModuleBase):
    r"""Draws residuals without an agent, for the warm-up and for distilling the noise critic.

    ``"normal"`` draws :math:`\sigma \varepsilon`, the training prior, which may leave the agent's box;
    ``"clipped"`` clips it to :math:`[-\delta, \delta]`; ``"uniform"`` draws from :math:`U[-\delta, \delta]`.
    :math:`\delta` is the decoder's, :math:`\sigma` the typical deviation of the source from the centre of the
    search: the prior's ``sigma`` around its mean, the start point's share of noise, or 1 around zero.

    ``TensorDictSequential(ResidualSampler(decoder), decoder)`` is a policy for the first steps of a collector
    (the environment's own random actions would be random *chunks* there).

    Args:
        decoder: the frozen policy.
        distribution: see above. By default ``"clipped"`` around a mean (``"uniform"`` if the prior has no
            noise) and ``"normal"`` around zero, as in DSRL-NA; DSRL-SAC uses ``"clipped"`` around zero.
        generator: source of randomness on the data's device; PyTorch's global one by default.

    Raises:
        ValueError: for an unknown distribution, or another than ``"uniform"`` for a prior without noise.
        KeyError: (when called) if the anchor is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, PriorDecoder, ResidualSampler, VelocityMLP, WarmPriorActor
        >>> decoder = PriorDecoder(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)), delta=0.5)
        >>> data = TensorDict({"prior": {"anchor": torch.zeros(100, 4, 2)}}, [100])
        >>> float(ResidualSampler(decoder)(data)["prior", "delta"].abs().max())
        0.5
    """

    def __init__(
        self,
        decoder: PriorDecoder,
        *,
        distribution: ResidualDistribution | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        sigma = residual_sigma(decoder)
        if distribution is None and has_anchor(decoder):
            distribution = "clipped" if sigma > 0 else "uniform"
        elif distribution is None:
            distribution = "normal"
        if distribution not in get_args(ResidualDistribution):
            raise ValueError(
                f"the distribution must be 'normal', 'clipped' or 'uniform', got {distribution!r}"
            )
        if distribution != "uniform" and sigma == 0:
            raise ValueError(f"a prior without noise leaves 'uniform', got the distribution {distribution!r}")
        self.distribution = distribution
        self.sigma = sigma
        self.delta = decoder.delta
        self.generator = generator
        self.in_keys = [keys.ANCHOR]
        self.out_keys = [keys.DELTA]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the residual."""
        anchor = tensordict.get(self.in_keys[0], None)
        if anchor is None:
            raise KeyError(f"ResidualSampler needs {self.in_keys[0]}: PriorAnchor writes it")
        like = {"dtype": anchor.dtype, "device": anchor.device, "generator": self.generator}
        if self.distribution == "uniform":
            delta = (2.0 * torch.rand(anchor.shape, **like) - 1.0) * self.delta
        else:
            delta = self.sigma * torch.randn(anchor.shape, **like)
        if self.distribution == "clipped":
            delta = delta.clamp(-self.delta, self.delta)
        return tensordict.set(self.out_keys[0], delta)
