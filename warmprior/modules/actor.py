"""The policy: prior sampler and ODE actor as one stateless TensorDict module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from multiprocessing.context import get_spawning_popen
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from warmprior import keys
from warmprior.history import ENTRIES
from warmprior.modules.normalize import Normalizer
from warmprior.modules.ode import ODEActor, Solver
from warmprior.modules.prior import Prior, Source
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.registry import Registered


class StartPoint(Registered, nn.Module):
    """Base class of points :math:`a_s` at a time :math:`s` in (0, 1), from which a policy integrates.

    The flow is trained from the prior's source as usual; at decisions integration starts on the way. A start
    point is trained before the flow, and saved with the policy (``start`` of
    :class:`~warmprior.WarmPriorActor`).

    Attributes:
        time: ``s``.
        noise_share: standard deviation of the point for source noise of 1.

    Examples:
        >>> from warmprior import StartPoint
        >>> class Halved(StartPoint):
        ...     time = noise_share = 0.5
        ...     def centre(self, history, observation):
        ...         return 0.0 * history["forecast"]
        ...     def forward(self, noise, history, observation):
        ...         return self.centre(history, observation) + self.noise_share * noise
        >>> Halved().config()
        {'name': 'Halved'}
    """

    time: float
    noise_share: float

    def centre(self, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Mean of the point, around which an agent searches, ``[*B, P, d_a]``; arguments as for a prior."""
        raise NotImplementedError

    def forward(self, noise: Tensor, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """The point, ``[*B, P, d_a]``, of a draw of the prior's source, ``[*B, P, d_a]``."""
        raise NotImplementedError


class PriorSampler(TensorDictModuleBase):
    """Draws the source sample: ``(observation, history) -> (loc, warm, noise)``.

    Args:
        prior: the source distribution.
        start: the point from which samplers start, if that is not the source itself.
        observation_key: key of the observation, ``[*B, To, d_o]``; only start points and priors that override
            :meth:`~Prior.distribution` read it.
        generator: source of randomness; per call: ``sampler(data, generator=...)``. Worker processes take
            none, since all of them would draw the same noise.

    Raises:
        KeyError: if an entry of the history is missing.
        ValueError: if the history has other lengths than the prior.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, PriorSampler
        >>> from warmprior.history import window_history
        >>> executed, steps = torch.ones(3, 2, 1), torch.full((3, 1), 2)
        >>> history = window_history(executed, steps, torch.zeros(3, 2, 1), chunk_length=2)
        >>> sampler = PriorSampler(PastPrior(2, sigma=0.0))
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


class WarmPriorActor(TensorDictModuleBase):
    """Flow-matching policy with a choice of source: ``(observation, history) -> (loc, warm, noise, chunk)``.

    Composes :class:`PriorSampler` and :class:`ODEActor`, and holds no state between calls. The history that
    it reads comes from :class:`~warmprior.ActionHistory` or :class:`~warmprior.ActionWindow`, so it works
    unchanged in ``env.rollout``, collectors, batched environments and replay buffers. It ignores TorchRL's
    ``ExplorationType``, because a flow needs its noise: seed the generator, or take a prior with ``sigma=0``.

    Args:
        network: velocity network, see :class:`ODEActor`.
        prior: the source distribution.
        nfe: network evaluations per chunk; per call: ``actor(data, nfe=1)``. 9 by default, or ``max_nfe``.
        max_nfe: the largest ``nfe`` that the training allows: 1 for a network that was trained at ``t = 0``.
        start: the point from which samplers start, if that is not the source itself.
        solver: see :func:`~warmprior.modules.ode.integrate`.
        grid: see :func:`~warmprior.modules.ode.integrate`.
        clip: see :class:`ODEActor`.
        guidance: makes chunks continue the one being executed; none by default.
        normalizer: the normaliser of the data; its :meth:`~warmprior.Normalizer.env_transforms` go next to
            the base environment.
        environment: JSON description of the environment that the policy was made for, saved with the policy
            (``python -m warmprior evaluate FOLDER``).
        generator: source of randomness of the sampler; per call: ``actor(data, generator=...)``.
        observation_key: key of the observation, ``[*B, To, d_o]``, or of several nested under it;
            :data:`warmprior.keys.CONDITIONED` where the network sees the last actions
            (:class:`~warmprior.HistoryObservation`).

    Raises:
        ValueError: if the network was built for another prediction length than the prior's, or see
            :class:`ODEActor`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.history import cold_history
        >>> actor = WarmPriorActor(VelocityMLP(7, 23, prediction_length=8), PastPrior(chunk_length=8), nfe=1)
        >>> data = TensorDict({
        ...     "observation": torch.zeros(2, 23),  # [To, d_o]: one environment
        ...     "history": cold_history([], 8, 8, action_dim=7),
        ... }, [])
        >>> actor(data)["vla_action", "chunk"].shape
        torch.Size([8, 7])
    """

    def __init__(
        self,
        network: nn.Module,
        prior: Prior,
        *,
        nfe: int | None = None,
        max_nfe: int | None = None,
        start: StartPoint | None = None,
        solver: Solver = "euler",
        grid: str = "uniform",
        clip: float | Sequence[float] | None = None,
        guidance: RealTimeChunking | None = None,
        normalizer: Normalizer | None = None,
        environment: Mapping[str, Any] | None = None,
        generator: torch.Generator | None = None,
        observation_key: NestedKey = keys.OBSERVATION,
    ) -> None:
        super().__init__()
        built_for = getattr(network, "prediction_length", prior.prediction_length)
        if built_for != prior.prediction_length:
            raise ValueError(
                f"the network was built for prediction_length={built_for}, but {prior} needs "
                f"{prior.prediction_length}"
            )
        self._nfe_was_given = nfe is not None
        self.sampler = PriorSampler(prior, start=start, observation_key=observation_key, generator=generator)
        self.ode = ODEActor(
            network,
            nfe=nfe,
            max_nfe=max_nfe,
            start_time=0.0 if start is None else start.time,
            solver=solver,
            grid=grid,
            clip=clip,
            guidance=guidance,
            observation_key=observation_key,
        )
        self.normalizer = normalizer
        self.environment = environment
        guided = [] if guidance is None else [keys.DELAY]
        self.in_keys = list(dict.fromkeys([observation_key, *self.sampler.in_keys, *guided]))
        self.out_keys = [*self.sampler.out_keys, *self.ode.out_keys]

    @property
    def prior(self) -> Prior:
        """The source distribution."""
        return self.sampler.prior

    @property
    def start(self) -> StartPoint | None:
        """The point from which samplers start, if that is not the source itself."""
        return self.sampler.start

    @property
    def network(self) -> nn.Module:
        """The velocity network."""
        return self.ode.network

    def forward(
        self, tensordict: TensorDictBase, nfe: int | None = None, generator: torch.Generator | None = None
    ) -> TensorDictBase:
        """Sample the source and integrate it to the chunk."""
        return self.integrate(self.sampler(tensordict, generator=generator), nfe=nfe)

    def integrate(self, tensordict: TensorDictBase, nfe: int | None = None) -> TensorDictBase:
        """Integrate a given source sample, ``[*B, P, d_a]`` under ``keys.NOISE``, to the chunk."""
        sigma = None if self.ode.guidance is None else self.sampler.source(tensordict).scale
        return self.ode(tensordict, nfe=nfe, sigma=sigma)

    def replace(self, **changes: Any) -> WarmPriorActor:
        """A copy of the policy, with the same parts, and some constructor arguments changed.

        A smaller ``max_nfe`` lowers ``nfe``.

        Examples:
            >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
            >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
            >>> one_step = actor.replace(nfe=1)
            >>> actor.ode.nfe, one_step.ode.nfe, one_step.network is actor.network
            (9, 1, True)
        """
        ode = self.ode
        mine = {
            "network": self.network,
            "prior": self.prior,
            "nfe": ode.nfe if self._nfe_was_given else None,
            "max_nfe": ode.max_nfe,
            "start": self.start,
            "solver": ode.solver,
            "grid": ode.grid,
            "clip": ode.clip,
            "guidance": ode.guidance,
            "normalizer": self.normalizer,
            "environment": self.environment,
            "generator": self.sampler.generator,
            "observation_key": self.in_keys[0],
        }
        options = mine | changes
        if "nfe" not in changes and ode.nfe > (options["max_nfe"] or ode.nfe):
            options["nfe"] = None
        return type(self)(**options)
