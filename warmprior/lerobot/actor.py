"""A flow policy of LeRobot as a TorchRL module with the library's keys."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor

from warmprior import keys
from warmprior.checks import check_shape
from warmprior.history import history_keys
from warmprior.lerobot.adapter import WarmPriorAdapter
from warmprior.lerobot.names import entry_names
from warmprior.lerobot.source import ChunkSource
from warmprior.modules.generator import Drawing
from warmprior.modules.network import network_observation
from warmprior.modules.prior import Prior
from warmprior.modules.sampling import Sampling, effective_temperature

_TURNS: WeakKeyDictionary[Any, Lock] = WeakKeyDictionary()
"""A lock per policy: decisions take turns, because each replaces the policy's sampler for its duration."""


class LeRobotFlow(TensorDictModuleBase):
    """The sampler of a LeRobot policy, which replaces :class:`~warmprior.ODEActor`.

    It is a deterministic map ``(noise, observation) -> chunk``, ``[*B, P, d_a]`` in the model's units: the
    padding around the prior's part is one fixed draw, unless a call passes its own. The policy's weights are
    not among its parameters. The options are those of :class:`LeRobotActor`.
    """

    guidance = None
    observation_key = keys.OBSERVATION

    def __init__(
        self,
        policy: Any,
        source: ChunkSource,
        *,
        names: Mapping[str, str] | None = None,
        preprocess: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
        nfe: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.sampling = Sampling(nfe=nfe)  # by default the model's own number of steps
        # Not a submodule: agents that contain this module must not train or save billions of weights.
        self._policy = (policy,)
        self.source = self.network = source  # the source has the width of actions
        inputs = policy.config.input_features
        self.names = entry_names(inputs) if names is None else dict(names)
        self.preprocess = preprocess
        self.seed = seed
        self.in_keys = [keys.NOISE, keys.OBSERVATION]
        self.out_keys = [keys.CHUNK]

    @property
    def policy(self) -> Any:
        """LeRobot's policy."""
        return self._policy[0]

    def forward(
        self, tensordict: TensorDictBase, nfe: int | None = None, padding: Tensor | None = None
    ) -> TensorDictBase:
        """Write the chunk; ``padding`` ``[prod(B), T, D]`` is the source outside the prior's part."""
        nfe = self.sampling.nfe if nfe is None else self.sampling.evaluations(nfe)
        noise = tensordict[keys.NOISE]
        if torch.is_grad_enabled() and noise.requires_grad:
            raise ValueError("LeRobot's samplers compute no gradients: use no_grad or detach the source")
        batch = noise.shape[:-2]
        a0 = noise.reshape(-1, *noise.shape[-2:])
        inputs = self._batch(network_observation(tensordict[keys.OBSERVATION], batch))
        if padding is None:
            # One draw for all rows, so that a chunk does not depend on the other rows.
            generator = torch.Generator(a0.device).manual_seed(self.seed)
            padding = self.source.place(a0[:1].detach(), generator).expand(len(a0), -1, -1)
        check_shape("padding", padding, (len(a0), self.source.length, self.source.width))
        whole = padding.clone()
        whole[:, self.source.positions, : self.source.action_dim] = a0
        chunks: list[Tensor] = []

        def draw(shape: torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
            return whole.to(dtype=dtype, device=device)

        # This source replaces that of a policy of the plugin.
        own = getattr(self.policy, "warm_adapter", None)
        with (
            _TURNS.setdefault(self.policy, Lock()),
            nullcontext() if own is None else own.aside(),
            self.source.port.sampling(self.policy, draw, chunks.append, nfe),
        ):
            self.source.port.predict(self.policy, inputs)
        chunk = chunks[0][:, self.source.positions, : self.source.action_dim]
        return tensordict.set(keys.CHUNK, chunk.to(noise).reshape(noise.shape))

    def _batch(self, observation: Tensor | TensorDictBase) -> dict[str, Any]:
        if isinstance(observation, Tensor):
            vectors = list(self.names.values())
            entries = {vectors[0] if len(vectors) == 1 else "observation.state": observation}
        else:
            if unnamed := sorted(set(observation.keys()) - set(self.names)):
                raise ValueError(f"names lacks {unnamed}: give names={{'state': 'observation.state', ...}}")
            entries = {self.names[str(name)]: value for name, value in observation.items()}
        steps = self.policy.config.n_obs_steps
        inputs: dict[str, Any] = {}
        for name, value in entries.items():
            if (count := value.shape[1]) < steps:
                raise ValueError(
                    f"{name} has {count} of {steps} observations: append ObservationStack({steps})"
                )
            value = value[:, -1] if steps == 1 else value[:, -steps:]
            if value.dtype == torch.uint8:
                value = value / 255.0
            elif value.is_floating_point() or name in self.policy.config.input_features:
                # In the precision that LeRobot's own loops give: robots and simulators also have float64.
                value = value.float()
            inputs[name] = value  # others, such as tokens, stay whole numbers
        return inputs if self.preprocess is None else self.preprocess(inputs)


class LeRobotActor(Drawing, TensorDictModuleBase):
    """A LeRobot policy with the keys of :class:`~warmprior.WarmPriorActor`.

    ``(observation, history) -> (loc, warm, noise, chunk)``: it acts in ``env.rollout`` and collectors behind
    :func:`~warmprior.policy_transforms`, and :class:`~warmprior.PriorDecoder` takes it as a frozen policy.
    Every decision draws new values for the rest of the model's source (padded dimensions, positions before
    the chunk); :class:`~warmprior.PriorDecoder` keeps them fixed. Chunks are in the model's units:
    denormalise them directly after the environment.

    Args:
        policy: a policy of LeRobot, see :class:`WarmPriorAdapter`, or such an adapter.
        prior: the source distribution that the policy was trained with; by default that of the adapter, or of
            a policy of the plugin.

    Keyword Args:
        std: standard deviation of the data in the model's units, ``[d_a]``, if ``sigma`` is in units of it.
        generator: source of randomness, also per call: ``actor(data, generator=...)``.
        names: LeRobot's name of each entry of the observation, such as
            ``{"state": "observation.state", "agentview_image": "observation.images.top"}``; by default the
            last part of LeRobot's, or all behind ``observation.images.`` where last parts are equal. An
            observation that is a tensor ``[*B, To, d]`` is the only entry, or ``observation.state``. Images
            of bytes become floats in [0, 1].
        preprocess: converts raw observations to the policy's batch, such as LeRobot's preprocessor; none by
            default.
        postprocess: converts actions ``[1, d_a]`` to those of a robot, such as LeRobot's postprocessor, for
            :class:`~warmprior.deploy.AsyncExecutor`; none by default.
        nfe: integration steps per chunk; the policy's own by default.
        seed: seed of the padding under a decoder.

    Raises:
        ValueError: see :class:`WarmPriorAdapter`; also if the prior is missing, an adapter has guidance,
            or actions are relative.
        KeyError: (when called) if an entry of the history is missing.

    Examples:
        >>> from warmprior import ActionHistory, ChunkStep, PastPrior
        >>> from warmprior.lerobot import LeRobotActor
        >>> actor = LeRobotActor(policy, PastPrior(16), nfe=1)  # doctest: +SKIP
        >>> env = TransformedEnv(base, Compose(ChunkStep(16), ActionHistory(16)))  # doctest: +SKIP
        >>> env.rollout(10, actor)["vla_action", "chunk"].shape  # doctest: +SKIP
        torch.Size([10, 16, 7])
    """

    normalizer = None
    environment = None
    start = None
    observation_key, history_key = keys.OBSERVATION, keys.HISTORY

    def __init__(
        self,
        policy: Any,
        prior: Prior | None = None,
        *,
        std: Tensor | None = None,
        generator: torch.Generator | None = None,
        names: Mapping[str, str] | None = None,
        preprocess: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
        postprocess: Callable[[Tensor], Tensor] | None = None,
        nfe: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        adapter = policy if isinstance(policy, WarmPriorAdapter) else getattr(policy, "warm_adapter", None)
        if adapter is not None:
            policy = adapter.policy
            if adapter.guidance is not None:
                raise ValueError("LeRobotActor has no guidance: give it an adapter without guidance")
            nfe = adapter.nfe if nfe is None else nfe
        if getattr(policy.config, "use_relative_actions", False):
            raise ValueError("relative actions (use_relative_actions) need WarmPriorAdapter")
        if prior is not None:
            source = ChunkSource(policy, prior, std)
        elif adapter is not None:
            source = adapter.source
        else:
            raise ValueError(f"{type(policy).__name__} has no prior of its own: give LeRobotActor one")
        self.ode = LeRobotFlow(policy, source, names=names, preprocess=preprocess, nfe=nfe, seed=seed)
        self.postprocess = postprocess
        #: The number of actions per chunk that LeRobot's own loop executes.
        self.execute = int(policy.config.n_action_steps)
        self.network, self.sampling = self.ode.network, self.ode.sampling
        self.generator = generator
        self.in_keys = [keys.OBSERVATION, *history_keys()]
        self.out_keys = [keys.LOC, keys.WARM, keys.NOISE, keys.CHUNK]

    @property
    def prior(self) -> Prior:
        """The source distribution."""
        return self.ode.source.prior

    @property
    def shapes(self) -> dict[str, tuple[int, ...]] | None:
        """The shapes of one step's entries, by name; ``None`` if only ``preprocess`` knows them."""
        features, names = self.ode.policy.config.input_features, self.ode.names
        if not set(names.values()) <= set(features):
            return None
        return {name: tuple(features[entry].shape) for name, entry in names.items()}

    @property
    def device(self) -> torch.device:
        """The device of LeRobot's policy."""
        return next(self.ode.policy.parameters()).device

    @dispatch(auto_batch_size=False)
    def forward(
        self, tensordict: TensorDictBase, nfe: int | None = None, generator: torch.Generator | None = None
    ) -> TensorDictBase:
        """Draw the source and the chunk."""
        chunks, generator = self.ode.source, self.chosen_generator(generator)
        source = chunks.distribution(tensordict.get(keys.HISTORY, None))
        temperature = effective_temperature(self.sampling.temperature)
        values = source.loc, source.sample(generator, temperature)
        loc, a0 = (chunks.scaled(value, source.warm) for value in values)
        tensordict.update({keys.LOC: loc, keys.WARM: source.warm, keys.NOISE: a0})
        padding = temperature * chunks.place(a0.reshape(-1, *a0.shape[-2:]), generator)
        return self.ode(tensordict, nfe=nfe, padding=padding)
