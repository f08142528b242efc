"""From the history to a source sample."""

from __future__ import annotations

from multiprocessing.context import get_spawning_popen
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from warmprior import keys
from warmprior.history import ENTRIES
from warmprior.modules.prior import Prior, Source
from warmprior.modules.start import StartPoint

__all__ = ["PriorSampler"]


class PriorSampler(TensorDictModuleBase):
    """Draws the source sample: ``(observation, history) -> (loc, warm, noise)``.

    Args:
        prior: the source distribution.

    Keyword Args:
        start: the point from which samplers start, if that is not the source itself.
        observation_key: key of the observation, ``[*B, To, d_o]``; only start points and priors that override
            :meth:`~Prior.distribution` read it.
        generator: source of randomness; PyTorch's global generator by default. Per call:
            ``sampler(data, generator=...)``. Worker processes take none, since all of them would draw the
            same noise.

    Raises:
        KeyError: if an entry of the history is missing.
        ValueError: if the history has other lengths than the prior.

    See Also:
        :class:`~warmprior.ODEActor`: integrates what it draws.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, PriorSampler
        >>> from warmprior.history import window_history
        >>> sampler = PriorSampler(PastPrior(2, sigma=0.0))
        >>> executed, steps = torch.ones(3, 2, 1), torch.full((3, 1), 2)
        >>> history = window_history(executed, steps, torch.zeros(3, 2, 1), chunk_length=2)
        >>> sampler(TensorDict({"history": history}, [3]))["prior", "noise"].unique()
        tensor([1.])
    """

    def __init__(
        self,
        prior: Prior,
        *,
        start: StartPoint | None = None,
        observation_key: NestedKey | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.prior, self.start, self.generator = prior, start, generator
        reads = start is not None or type(prior).distribution is not Prior.distribution
        self.observation_key = observation_key if reads else None
        observed = [] if self.observation_key is None else [self.observation_key]
        self.in_keys = [*((keys.HISTORY, name) for name in ENTRIES), *observed]
        self.out_keys = [keys.LOC, keys.WARM, keys.NOISE]

    def __getstate__(self) -> Any:
        if self.generator is not None and get_spawning_popen() is not None:
            raise RuntimeError(  # TorchRL's collectors swallow a TypeError
                "a policy with a generator cannot go to worker processes: all of them would draw the same "
                "noise. Build it without one (actor.replace(generator=None)), and seed the collector with "
                "set_seed"
            )
        return super().__getstate__()

    def source(self, tensordict: TensorDictBase) -> Source:
        """The source of decisions or windows, ``[*B]``."""
        return self.prior.distribution(*self._inputs(tensordict))

    def forward(self, tensordict: TensorDictBase, generator: torch.Generator | None = None) -> TensorDictBase:
        """Write the mean, the warm positions, and the sample."""
        source = self.source(tensordict)
        point = source.sample(self.generator if generator is None else generator)
        if self.start is not None:
            point = self.start(point, *self._inputs(tensordict))
        for key, value in zip(self.out_keys, (source.loc, source.warm, point), strict=True):
            tensordict.set(key, value)
        return tensordict

    def _inputs(self, tensordict: TensorDictBase) -> tuple[Any, Any]:
        history, key = tensordict.get(keys.HISTORY, None), self.observation_key
        return history, None if key is None else tensordict.get(key, None)
