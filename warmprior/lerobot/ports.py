"""One small port per family of LeRobot's flow policies, which replaces the noise that the family draws."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial, wraps
from importlib.metadata import version
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from warmprior.modules.real_time_chunking import Velocity

Source = Callable[[torch.Size, torch.dtype, torch.device], Tensor]
"""A function ``(shape [B, T, D], dtype, device) -> a_0`` that replaces a draw."""


class SourceInjection(TorchFunctionMode):
    """A context that replaces the one draw by ``torch.randn`` or ``randn_like`` of shape ``[B, T, D]``.

    Raises RuntimeError at the exit unless there was exactly one, since the port is for another policy then.

    Examples:
        >>> import torch
        >>> from warmprior.lerobot.ports import SourceInjection
        >>> with SourceInjection(4, 2, lambda shape, dtype, device: torch.ones(shape)):
        ...     noise, other = torch.randn(3, 4, 2), torch.randn(3)
        >>> bool((noise == 1).all()), other.shape
        (True, torch.Size([3]))
        >>> with SourceInjection(4, 2, lambda shape, dtype, device: torch.ones(shape)):
        ...     noise = torch.rand(3, 4, 2)
        Traceback (most recent call last):
            ...
        RuntimeError: the policy drew normal noise of shape [B, 4, 2] 0 times, not once: ...
    """

    def __init__(self, length: int, width: int, source: Source) -> None:
        super().__init__()
        self.expected = (length, width)
        self.source = source
        self.draws = 0

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Let all calls pass except the draw."""
        kwargs = kwargs or {}
        if func is torch.randn:
            size = kwargs.get("size", args[0] if args and not isinstance(args[0], int) else args)
            like = torch.empty(0, dtype=kwargs.get("dtype"), device=kwargs.get("device"))
        elif func is torch.randn_like:
            size, like = args[0].shape, args[0]
        else:
            return func(*args, **kwargs)
        if len(size) != 3 or tuple(size[1:]) != self.expected:
            return func(*args, **kwargs)
        self.draws += 1
        dtype, device = kwargs.get("dtype") or like.dtype, kwargs.get("device") or like.device
        return self.source(torch.Size(size), dtype, torch.device(device))

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Check the count, unless an error has been raised inside."""
        super().__exit__(kind, error, trace)
        if kind is None:
            length, width = self.expected
            _check_once(f"the policy drew normal noise of shape [B, {length}, {width}]", self.draws)


def _check_once(what: str, times: int) -> None:
    if times != 1:
        raise RuntimeError(f"{what} {times} times, not once: its source cannot be replaced in this lerobot")


Record = Callable[[Tensor], None]
"""A function that receives a sampler's result, ``[B, T, >= d_a]``."""


def check_no_noise(options: Mapping[str, Any]) -> None:
    """Raise ValueError if a call passes noise, which the prior already draws."""
    if options.get("noise") is not None:
        raise ValueError("the prior draws the noise: leave noise= out, or leave out the second prior")


@contextmanager
def _replaced(policy: Any, path: str, make: Callable[[Any], Any]) -> Iterator[None]:
    """Replace the attribute at a dotted path below a policy by ``make(attribute)``, inside the context."""
    place, _, name = path.rpartition(".")
    owner = vars(attrgetter(place)(policy) if place else policy)
    before = owner.get(name, _replaced)  # a method lies in the class
    owner[name] = make(attrgetter(path)(policy))
    try:
        yield
    finally:
        if before is _replaced:
            del owner[name]
        else:
            owner[name] = before


def _around(policy: Any, path: str, call: Callable[..., Any]) -> AbstractContextManager[None]:
    """Replace a method by a call of ``call`` with it and its arguments, inside the context."""
    return _replaced(policy, path, lambda method: wraps(method)(partial(call, method)))


@dataclass(frozen=True)
class FlowPort:
    """The port of a family of policies: the chunk's shape, and the place where its noise is drawn.

    Training and sampling run inside :meth:`training` and :meth:`sampling`, which check that the source is
    used exactly once. Families that do not draw their noise with ``torch.randn`` in the loss and the sampler
    have subclasses.

    Args:
        chunk_length: dotted path in a policy to the length of the noisy chunk.
        chunk_width: dotted path to its width.
        sampler: dotted path to the method that samples a chunk.
        steps: dotted path to the number of integration steps.

    Examples:
        >>> from warmprior.lerobot import PORTS
        >>> from types import SimpleNamespace
        >>> smolvla = SimpleNamespace(config=SimpleNamespace(chunk_size=50, max_action_dim=32))
        >>> port = PORTS["0.6"]["smolvla"]
        >>> port.length(smolvla), port.width(smolvla), port.lead(smolvla)
        (50, 32, 0)
    """

    chunk_length: str
    chunk_width: str
    sampler: str
    steps: str

    bounded = False
    """True if the family's postprocessors clamp actions to [-1, 1]."""

    def length(self, policy: Any) -> int:
        """Return ``T``, the length of the noisy chunk."""
        return int(attrgetter(self.chunk_length)(policy))

    def width(self, policy: Any) -> int:
        """Return ``D``, the width of the noisy chunk, including padding beyond the action."""
        return int(attrgetter(self.chunk_width)(policy))

    def lead(self, policy: Any) -> int:
        """Return the number of the chunk's positions before the current step."""
        return 0

    def normalization(self, policy: Any) -> str | None:
        """Return LeRobot's name of the actions' normalisation, such as ``"MEAN_STD"`` or ``"MIN_MAX"``."""
        return getattr(policy.config.normalization_mapping.get("ACTION"), "value", None)

    def check(self, policy: Any) -> None:
        """Raise ValueError for an option that would make the source inexact."""

    def training(self, policy: Any, source: Source) -> AbstractContextManager[Any]:
        """Return a context for one ``policy.forward``, whose loss uses this source."""
        return SourceInjection(self.length(policy), self.width(policy), source)

    @contextmanager
    def sampling(self, policy: Any, source: Source, record: Record, nfe: int | None = None) -> Iterator[None]:
        """Let new chunks start from the source, and call ``record`` with each, including its padding."""

        def sampled(call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            output = self.sample(policy, source, call, *args, **kwargs)
            chunk = output if isinstance(output, Tensor) else output["action_pred"]
            # Within the output, so that the remembered actions are those that are executed.
            record(chunk.clamp_(-1.0, 1.0) if self.bounded else chunk)
            return output

        with (
            _replaced(policy, self.steps, lambda own: own if nfe is None else nfe),
            _around(policy, self.sampler, sampled),
        ):
            yield

    def sample(self, policy: Any, source: Source, call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call the policy's sampler with noise from the source."""
        with SourceInjection(self.length(policy), self.width(policy), source):
            return call(*args, **kwargs)

    def guiding(self, policy: Any, guide: Callable[[Velocity], Velocity]) -> AbstractContextManager[Any]:
        """Return a context in which ``guide`` changes the sampler's velocities, with the source at time 0."""
        raise ValueError(f"guidance is for pi0, pi05 and smolvla: leave it out with {type(policy).__name__}")

    def predict(self, policy: Any, batch: dict[str, Any]) -> None:
        """Sample a chunk for a batch of observations, without a queue."""
        policy.predict_action_chunk(batch)


class OpenPiPort(FlowPort):
    """The port of pi0, pi0.5 and SmolVLA, whose models, even compiled, take the noise as an argument."""

    def check(self, policy: Any) -> None:
        """Raise ValueError if actions are in another space than the model's."""
        if getattr(policy.config, "adapt_to_pi_aloha", False):
            raise ValueError("adapt_to_pi_aloha=True: convert the dataset to the model's actions instead")

    @contextmanager
    def training(self, policy: Any, source: Source) -> Iterator[None]:
        """Pass the source to the model as an argument."""
        signature, calls = inspect.signature(type(policy.model).forward), []

        def from_source(forward: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(policy.model, *args, **kwargs)
            actions = bound.arguments["actions"]
            calls.append(actions.shape)
            bound.arguments["noise"] = source(actions.shape, torch.float32, actions.device)
            return forward(*bound.args[1:], **bound.kwargs)

        with _around(policy, "model.forward", from_source):
            yield
        _check_once(f"{type(policy).__name__} evaluated its model", len(calls))

    def sample(self, policy: Any, source: Source, call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Pass the source to the sampler as an argument."""
        check_no_noise(kwargs)
        image = args[0][0]
        shape = torch.Size((len(image), self.length(policy), self.width(policy)))
        return call(*args, **kwargs | {"noise": source(shape, torch.float32, image.device)})

    def guiding(self, policy: Any, guide: Callable[[Velocity], Velocity]) -> AbstractContextManager[Any]:
        """Guide velocities with reversed sign: these families integrate from 1, the source, to 0."""
        rtc = getattr(policy.config, "rtc_config", None)
        if rtc is not None and rtc.enabled:
            raise ValueError("the policy's own rtc_config guides already: turn it off, or leave out guidance")

        def guided(
            step: Callable[..., Tensor], *args: Any, x_t: Tensor, timestep: Tensor, **kw: Any
        ) -> Tensor:
            def velocity(t: Tensor, a: Tensor) -> Tensor:
                return -step(*args, x_t=a, timestep=1 - t, **kw)

            return -guide(velocity)(1 - timestep, x_t)

        return _around(policy, "model.denoise_step", guided)


class GrootPort(FlowPort):
    """The port of GR00T N1.7."""

    bounded = True

    def check(self, policy: Any) -> None:
        """Raise ValueError for relative actions, which cannot be expressed at the next state from outside."""
        if getattr(policy.config, "use_relative_actions", False):
            raise ValueError(
                "GR00T's use_relative_actions=True is not supported: train with absolute actions"
            )


class GrootN15Port(FlowPort):
    """The port of GR00T N1.5, which deviates from its configuration."""

    def check(self, policy: Any) -> None:
        """Raise ValueError if the action head repeats each batch before it draws noise."""
        copies = policy._groot_model.action_head.config.expand_batch
        if copies not in (None, 1):
            raise ValueError(f"expand_batch={copies} does not repeat the history: set it to None")

    def normalization(self, policy: Any) -> str:
        """Return the preprocessor's normalisation, which ignores ``normalization_mapping``."""
        return "MIN_MAX"

    @contextmanager
    def sampling(self, policy: Any, source: Source, record: Record, nfe: int | None = None) -> Iterator[None]:
        """Let ``select_action`` execute the first actions of a chunk."""

        def predicted(predict: Callable[..., Tensor], *args: Any, **kwargs: Any) -> Tensor:
            # Its queue takes the whole chunk and keeps the last n_action_steps actions.
            return predict(*args, **kwargs)[:, : policy.config.n_action_steps]

        with (
            _around(policy, "predict_action_chunk", predicted),
            super().sampling(policy, source, record, nfe),
        ):
            yield


class MultiTaskDiTPort(FlowPort):
    """The port of multi_task_dit, whose chunk begins at the first of its observations."""

    def lead(self, policy: Any) -> int:
        """Return the number of observations before the last one."""
        return policy.config.n_obs_steps - 1

    def check(self, policy: Any) -> None:
        """Raise ValueError unless the policy's objective is flow matching."""
        if policy.config.objective != "flow_matching":
            raise ValueError(f"objective={policy.config.objective!r} is not a flow: set 'flow_matching'")

    def predict(self, policy: Any, batch: dict[str, Any]) -> None:
        """Sample a chunk without ``predict_action_chunk``, which takes observations from the queue."""
        policy.eval()
        if policy.config.n_obs_steps == 1:  # the queue adds a time dimension even to a single one
            inputs = policy.config.input_features
            batch = {name: v.unsqueeze(1) if name in inputs else v for name, v in batch.items()}
        with torch.no_grad():
            policy._generate_actions(policy._prepare_batch(batch))


_OPENPI = "config.chunk_size", "config.max_action_dim", "model.sample_actions"
_HEAD = "_groot_model.action_head"

PORTS: dict[str, dict[str, FlowPort]] = {
    "0.6": {
        "pi0": OpenPiPort(*_OPENPI, "config.num_inference_steps"),
        "pi05": OpenPiPort(*_OPENPI, "config.num_inference_steps"),
        "smolvla": OpenPiPort(*_OPENPI, "config.num_steps"),
        "groot": GrootPort(
            "_groot_model.config.action_horizon",
            "_groot_model.config.max_action_dim",
            f"{_HEAD}.get_action_with_features",
            f"{_HEAD}.num_inference_timesteps",
        ),
        "multi_task_dit": MultiTaskDiTPort(
            "config.horizon",
            "objective.action_dim",
            "objective.conditional_sample",
            "objective.config.num_integration_steps",
        ),
        "xvla": FlowPort(
            "config.chunk_size", "model.dim_action", "model.generate_actions", "config.num_denoising_steps"
        ),
    },
    "0.5.1": {
        "groot": GrootN15Port(
            f"{_HEAD}.config.action_horizon",
            f"{_HEAD}.config.action_dim",
            f"{_HEAD}.get_action",
            f"{_HEAD}.num_inference_timesteps",
        )
    },
}
"""The ports by release of LeRobot (``"0.6"`` is all of 0.6), and by LeRobot's name of the family.

``"groot"`` is GR00T N1.7 in 0.6, and N1.5 in 0.5.1, whose other families are not supported.
"""


def port_for(policy: Any) -> FlowPort:
    """Return the port of a policy's family, or of its base class, in the installed release of lerobot."""
    installed = version("lerobot")
    ports = next((PORTS[release] for release in PORTS if f"{installed}.".startswith(f"{release}.")), None)
    supported = "; ".join(f"{release}: {', '.join(families)}" for release, families in PORTS.items())
    if ports is None:
        raise ImportError(f"lerobot {installed} is not supported; by release supported are {supported}")
    names = [getattr(kind, "name", None) for kind in type(policy).__mro__]
    port = next((ports[name] for name in names if name in ports), None)
    if port is None:
        policy_name = f"{type(policy).__name__} of lerobot {installed}"
        raise ValueError(f"{policy_name} is not supported; by release supported are {supported}")
    port.check(policy)
    return port
