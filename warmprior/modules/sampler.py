"""From a prior's mean to a source sample."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from warmprior import keys
from warmprior.modules.prior import Prior

__all__ = ["PriorSampler"]


class PriorSampler(TensorDictModuleBase):
    """Draws where the flow starts: ``(observation, loc, warm) -> noise``, see :meth:`Prior.start`.

    Args:
        prior: the source distribution.

    Keyword Args:
        observation_key: key of the observation, ``[*B, To, d_o]``; without one the prior is given none,
            as the paper's sources need none.
        loc_key: key of the mean, ``[*B, P, d_a]``.
        warm_key: key of the warm mask, bool ``[*B, P, 1]``.
        noise_key: key written, ``[*B, P, d_a]``.
        generator: source of randomness; PyTorch's global generator by default. Per call:
            ``sampler(data, generator=...)``.

    Raises:
        KeyError: if an input key is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, PriorSampler
        >>> sampler = PriorSampler(PastPrior(2, sigma=0.0))
        >>> data = TensorDict({"prior": {"loc": torch.ones(3, 2, 1),
        ...                              "warm": torch.ones(3, 2, 1, dtype=torch.bool)}}, [3])
        >>> sampler(data)["prior", "noise"].unique()
        tensor([1.])
    """

    def __init__(
        self,
        prior: Prior,
        *,
        observation_key: NestedKey | None = None,
        loc_key: NestedKey = keys.LOC,
        warm_key: NestedKey = keys.WARM,
        noise_key: NestedKey = keys.NOISE,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.prior = prior
        self.generator = generator
        self.observation_key = observation_key
        self.in_keys = [loc_key, warm_key]
        self.out_keys = [noise_key]

    def forward(
        self, tensordict: TensorDictBase, generator: torch.Generator | None = None
    ) -> TensorDictBase:
        """Write the source sample."""
        loc, warm = (tensordict.get(key, None) for key in self.in_keys)
        if loc is None or warm is None:
            missing = [key for key, v in zip(self.in_keys, (loc, warm), strict=True) if v is None]
            raise KeyError(
                f"PriorSampler needs the keys {self.in_keys}; missing: {missing}. ActionHistory "
                "writes them in an environment, ActionWindow in a replay buffer"
            )
        generator = self.generator if generator is None else generator
        observation = None
        if self.observation_key is not None:
            observation = tensordict.get(self.observation_key, None)
        return tensordict.set(self.out_keys[0], self.prior.start(loc, warm, generator, observation))
