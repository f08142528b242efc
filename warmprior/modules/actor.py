"""The policy: prior sampler and ODE actor as one stateless TensorDict module."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from warmprior import keys
from warmprior.history import history_keys
from warmprior.modules.generator import Drawing
from warmprior.modules.normalize import Normalizer
from warmprior.modules.ode import ODEActor
from warmprior.modules.prior import Prior
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.recording import Recording
from warmprior.modules.registry import Registered, kept_arguments
from warmprior.modules.sampling import effective_temperature
from warmprior.modules.source import Source


class StartPoint(Registered, nn.Module):
    """Base class of points :math:`a_s` at a time :math:`s` in (0, 1), from which a policy integrates.

    The flow is trained from the prior's source as usual; at decisions integration starts from this point. A
    start point learns before the flow (:meth:`fit`) and is then frozen, and saved with the policy (``start``
    of :class:`~warmprior.WarmPriorActor`).

    Attributes:
        time: ``s``.
        noise_share: standard deviation of the point per unit of source noise.

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

    fit: Any = Prior.fit

    def centre(self, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Return the point's mean, ``[*B, P, d_a]``, around which an agent searches."""
        raise NotImplementedError

    def forward(self, noise: Tensor, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Map a source sample ``[*B, P, d_a]`` to the start point ``[*B, P, d_a]``."""
        raise NotImplementedError


class PriorSampler(Drawing, TensorDictModuleBase):
    """Draws the source sample: ``(observation, history) -> (loc, warm, noise)``.

    Args:
        prior: the source distribution.
        start: the point from which integration starts; the source sample by default.
        observation_key: key of the observation, ``[*B, To, d_o]``; only start points and priors that override
            :meth:`~Prior.distribution` read it.
        history_key: key of the history (:mod:`warmprior.history`).
        source_key: where to write ``"loc"``, ``"warm"`` and ``"noise"``.
        generator: source of randomness, also per call: ``sampler(data, generator=...)``. A sampler with a
            generator cannot draw in worker processes, since all of them would draw the same noise.

    Raises:
        KeyError: if an entry of the history is missing.
        ValueError: if the history's lengths differ from the prior's.

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
        observation_key: NestedKey = keys.OBSERVATION,
        history_key: NestedKey = keys.HISTORY,
        source_key: NestedKey = keys.SOURCE,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.prior, self.start, self.generator = prior, start, generator
        self.history_key = history_key
        reads = start is not None or type(prior).distribution is not Prior.distribution
        self.observation_key = observation_key if reads else None
        observed = [] if self.observation_key is None else [self.observation_key]
        self.in_keys = [*history_keys(history_key), *observed]
        self.out_keys = [unravel_key((source_key, name)) for name in ("loc", "warm", "noise")]

    def source(self, tensordict: TensorDictBase) -> Source:
        """Return the source for decisions or windows ``[*B]``."""
        return self.prior.distribution(*self._inputs(tensordict))

    @dispatch(auto_batch_size=False)
    def forward(
        self,
        tensordict: TensorDictBase,
        generator: torch.Generator | None = None,
        temperature: float | None = None,
    ) -> TensorDictBase:
        """Write the mean, the mask of warm positions, and a sample at a temperature."""
        source = self.source(tensordict)
        point = source.sample(self.chosen_generator(generator), effective_temperature(temperature))
        if self.start is not None:
            point = self.start(point, *self._inputs(tensordict))
        for key, value in zip(self.out_keys_source, (source.loc, source.warm, point), strict=True):
            tensordict.set(key, value)
        return tensordict

    def _inputs(self, tensordict: TensorDictBase) -> tuple[Any, Any]:
        history, key = tensordict.get(self.history_key, None), self.observation_key
        return history, None if key is None else tensordict.get(key, None)


USUAL_KEYS = {"history_key": keys.HISTORY, "source_key": keys.SOURCE, "chunk_key": keys.CHUNK}


def check_usual_keys(policy: Any, whose: str) -> None:
    """Raise ValueError if a policy has keys of its own where only the default ones are supported."""
    own = getattr(policy, "tensor_keys", USUAL_KEYS)
    if changes := [f"{name}={key!r}" for name, key in USUAL_KEYS.items() if own[name] != key]:
        raise ValueError(f"{whose} needs the default keys: give it policy.replace({', '.join(changes)})")


class WarmPriorActor(TensorDictModuleBase):
    """A flow-matching policy with any source: ``(observation, history) -> (loc, warm, noise, chunk)``.

    It composes :class:`PriorSampler` and :class:`ODEActor`, and holds no state between calls. It reads
    the history that :class:`~warmprior.ActionHistory` or :class:`~warmprior.ActionWindow` writes, so it
    works unchanged in ``env.rollout``, collectors, batched environments and replay buffers. The flow starts
    at a random draw from the source; pass a seeded generator to make it reproducible. Under every
    ``ExplorationType`` but ``RANDOM`` it starts at the mean, unless the policy has a ``temperature``.

    Args:
        network: velocity network, see :class:`ODEActor`.
        prior: the source distribution.
        start: the point from which integration starts; the source sample by default.
        guidance: makes chunks continue the one being executed; none by default.
        normalizer: the normaliser of the data; its :func:`~warmprior.normalizing_transforms` come after the
            base environment and any transforms that convert actions or images.
        environment: JSON description of the environment that the policy was made for, saved with the policy
            for ``python -m warmprior evaluate FOLDER``.
        recording: what the policy was trained on, saved with it: its observations by name, and their rate.
        generator: random generator of the sampler, which can also be passed per call: ``actor(data,
            generator=...)``.
        observation_key: key of the observation, ``[*B, To, d_o]``, or of a group of observations nested under
            it; :data:`warmprior.keys.CONDITIONED` if the network sees the last actions
            (:class:`~warmprior.HistoryObservation`).
        history_key: key of the history.
        source_key: where ``"loc"``, ``"warm"`` and ``"noise"`` are written.
        chunk_key: where the chunk is written. Policies that share an environment need different keys
            (:class:`~warmprior.ChunkStep`).
        spec: TorchRL's spec of the chunk, or of several outputs by key; none by default. It is not saved.
        **sampling: options of :class:`Sampling`, such as ``nfe`` and ``temperature``; the number of network
            evaluations can also be set per call: ``actor(data, nfe=1)``.

    Raises:
        ValueError: if network and prior have different prediction lengths, or an option does not fit
            (:class:`ODEActor`).

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
        start: StartPoint | None = None,
        guidance: RealTimeChunking | None = None,
        normalizer: Normalizer | None = None,
        environment: Mapping[str, Any] | None = None,
        recording: Recording | None = None,
        generator: torch.Generator | None = None,
        observation_key: NestedKey = keys.OBSERVATION,
        history_key: NestedKey = keys.HISTORY,
        source_key: NestedKey = keys.SOURCE,
        chunk_key: NestedKey = keys.CHUNK,
        spec: TensorSpec | None = None,
        **sampling: Any,
    ) -> None:
        super().__init__()
        built_for = getattr(network, "prediction_length", prior.prediction_length)
        if built_for != prior.prediction_length:
            raise ValueError(
                f"the network was built for prediction_length={built_for}, but {prior} needs "
                f"{prior.prediction_length}"
            )
        observation_key, chunk_key = unravel_key(observation_key), unravel_key(chunk_key)
        read: dict[str, NestedKey] = {
            "observation_key": observation_key,
            "history_key": unravel_key(history_key),
            "source_key": unravel_key(source_key),
        }
        #: Keys of the policy's inputs and outputs, as arguments of the constructor.
        self.tensor_keys = read | {"chunk_key": chunk_key}
        began = 0.0 if start is None else start.time
        self.ode = ODEActor(network, start_time=began, guidance=guidance, **self.tensor_keys, **sampling)
        self.sampler = PriorSampler(prior, start=start, generator=generator, **read)
        #: The options for drawing a chunk.
        self.sampling = self.ode.sampling
        self.observation_key, self.history_key = observation_key, read["history_key"]
        #: True if the network sees the last actions, see :class:`~warmprior.HistoryObservation`.
        self.sees_history = observation_key == keys.CONDITIONED
        self.normalizer = normalizer
        self.environment = environment
        self.recording = recording
        #: Specs of outputs, by their keys.
        self.spec = spec if spec is None or isinstance(spec, Composite) else Composite({chunk_key: spec})
        _, *read_by_flow = self.ode.in_keys
        self.in_keys = list(dict.fromkeys([observation_key, *self.sampler.in_keys, *read_by_flow]))
        self.out_keys = [*self.sampler.out_keys, chunk_key]

    @property
    def prior(self) -> Prior:
        """The source distribution."""
        return self.sampler.prior

    @property
    def start(self) -> StartPoint | None:
        """The point from which integration starts, or ``None`` for the source sample."""
        return self.sampler.start

    @property
    def network(self) -> nn.Module:
        """The velocity network."""
        return self.ode.network

    @dispatch(auto_batch_size=False)
    def forward(
        self,
        tensordict: TensorDictBase,
        nfe: int | None = None,
        generator: torch.Generator | None = None,
        **unknown: Any,
    ) -> TensorDictBase:
        """Draw a source sample and integrate it to the chunk."""
        # The signature takes any keyword, so that torch.export accepts entries as keyword arguments.
        if unknown:
            raise TypeError(f"unexpected arguments {sorted(unknown)}: the entries are {self.in_keys}")
        drawn = self.sampler(tensordict, generator=generator, temperature=self.sampling.temperature)
        return self.integrate(drawn, nfe=nfe)

    def integrate(self, tensordict: TensorDictBase, nfe: int | None = None) -> TensorDictBase:
        """Integrate a given source sample, ``[*B, P, d_a]`` under ``(source_key, "noise")``, to the chunk."""
        sigma = None if self.ode.guidance is None else self.sampler.source(tensordict).scale
        return self.ode(tensordict, nfe=nfe, sigma=sigma)

    def replace(self, **changes: Any) -> WarmPriorActor:
        """Return a copy of the policy that shares its parts, with some constructor arguments changed.

        A subclass keeps its constructor's further arguments in attributes of the same names.

        Examples:
            >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
            >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
            >>> one_step = actor.replace(nfe=1)
            >>> actor.sampling.nfe, one_step.sampling.nfe, one_step.network is actor.network
            (None, 1, True)
        """
        arguments = {"guidance": self.ode.guidance, "generator": self.sampler.generator}
        arguments |= self.tensor_keys | asdict(self.sampling)
        return type(self)(**arguments | kept_arguments(self, known=arguments) | changes)
