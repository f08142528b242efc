"""One small port per family of LeRobot's flow policies: where it draws its noise."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib.metadata import version
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

from warmprior.lerobot.injection import Source, SourceInjection

Velocity = Callable[[Tensor, Tensor], Tensor]
"""``(t [B], a_t [B, T, D]) -> [B, T, D]``."""

Record = Callable[[Tensor], None]
"""Takes what a sampler returned, ``[B, T, >= d_a]``."""


def check_steps(nfe: int | None) -> None:
    """A ``ValueError`` for a number of integration steps below 1."""
    if nfe is not None and nfe < 1:
        raise ValueError(f"nfe is the number of integration steps: it must be at least 1, got {nfe}")


def _place(policy: Any, path: str) -> tuple[Any, str]:
    """The object below a policy that has the last name of a dotted path, and that name."""
    owner, _, name = path.rpartition(".")
    return (attrgetter(owner)(policy) if owner else policy), name


@contextmanager
def _steps(policy: Any, path: str, nfe: int | None) -> Iterator[None]:
    """Changes the number of integration steps inside the context."""
    holder, name = _place(policy, path)
    before = getattr(holder, name)
    setattr(holder, name, before if nfe is None else nfe)
    try:
        yield
    finally:
        setattr(holder, name, before)


@contextmanager
def _replaced(policy: Any, path: str, around: Callable[..., Any]) -> Iterator[None]:
    """Calls ``around`` with a method, and its arguments, instead of the method inside the context."""
    owner, name = _place(policy, path)
    method, before = getattr(owner, name), vars(owner).get(name)

    @wraps(method)
    def called(*args: Any, **kwargs: Any) -> Any:
        return around(method, *args, **kwargs)

    vars(owner)[name] = called
    try:
        yield
    finally:
        if before is None:
            del vars(owner)[name]
        else:
            vars(owner)[name] = before


@dataclass(frozen=True)
class FlowPort:
    """Describes a family of policies: the chunk's shape, and where its noise is drawn.

    Training and sampling run inside :meth:`training` and :meth:`sampling`, which check that the source is
    used exactly once. Families that do not draw their noise by ``torch.randn`` in the loss and in the sampler
    are subclasses.

    Args:
        chunk_length: where in a policy the length of the noisy chunk is, as a dotted path.
        chunk_width: likewise its width.
        sampler: likewise the method that samples a chunk.
        steps: likewise the number of integration steps.

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

    def length(self, policy: Any) -> int:
        """``T``, the length of the noisy chunk."""
        return int(attrgetter(self.chunk_length)(policy))

    def width(self, policy: Any) -> int:
        """``D``, the width of the noisy chunk, with padding beyond the action's."""
        return int(attrgetter(self.chunk_width)(policy))

    def lead(self, policy: Any) -> int:
        """Positions of the chunk that lie before the current step."""
        return 0

    def normalization(self, policy: Any) -> str | None:
        """How the preprocessor normalises actions, by LeRobot's name: ``"MEAN_STD"``, ``"MIN_MAX"``."""
        return getattr(policy.config.normalization_mapping.get("ACTION"), "value", None)

    def check(self, policy: Any) -> None:
        """Refuse options that would make the source inexact, with a ``ValueError`` that names one."""

    def training(self, policy: Any, source: Source) -> AbstractContextManager[Any]:
        """Context of one ``policy.forward``, whose loss uses this source."""
        return SourceInjection(self.length(policy), self.width(policy), source)

    @contextmanager
    def sampling(self, policy: Any, source: Source, record: Record, nfe: int | None = None) -> Iterator[None]:
        """Context in which new chunks start from the source; ``record`` is called with each, padded."""

        def sampled(sample: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            output = self.sample(policy, source, sample, *args, **kwargs)
            record(output if isinstance(output, Tensor) else output["action_pred"])
            return output

        with _steps(policy, self.steps, nfe), _replaced(policy, self.sampler, sampled):
            yield

    def sample(
        self, policy: Any, source: Source, sample: Callable[..., Any], *args: Any, **kwargs: Any
    ) -> Any:
        """Call the policy's sampler, with its noise from the source."""
        with SourceInjection(self.length(policy), self.width(policy), source):
            return sample(*args, **kwargs)

    def guiding(self, policy: Any, guide: Callable[[Velocity], Velocity]) -> AbstractContextManager[Any]:
        """Context in which ``guide`` changes the sampler's velocities, whose source is at time 0."""
        raise ValueError(f"guidance is for pi0, pi05 and smolvla: leave it out with {type(policy).__name__}")

    def predict(self, policy: Any, batch: dict[str, Any]) -> None:
        """Sample a chunk for a batch of observations, without a queue."""
        policy.predict_action_chunk(batch)


class OpenPiPort(FlowPort):
    """For pi0, pi0.5 and SmolVLA, whose models take the noise as an argument (compiled ones too)."""

    def check(self, policy: Any) -> None:
        """Of the options that only these have."""
        if getattr(policy.config, "adapt_to_pi_aloha", False):
            raise ValueError(
                "adapt_to_pi_aloha=True gives actions in another space than the model's, so the source "
                "would have the wrong mean: convert the dataset instead, and turn it off"
            )

    @contextmanager
    def training(self, policy: Any, source: Source) -> Iterator[None]:
        """The model's argument."""
        signature, calls = inspect.signature(type(policy.model).forward), []

        def from_source(forward: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(policy.model, *args, **kwargs)
            actions = bound.arguments["actions"]
            calls.append(actions.shape)
            bound.arguments["noise"] = source(actions.shape, torch.float32, actions.device)
            return forward(*bound.args[1:], **bound.kwargs)

        with _replaced(policy, "model.forward", from_source):
            yield
        if len(calls) != 1:
            raise RuntimeError(
                f"{type(policy).__name__} evaluated its model {len(calls)} times in one loss, not once: its "
                "source cannot be replaced. Use the version of lerobot that this port is for"
            )

    def sample(
        self, policy: Any, source: Source, sample: Callable[..., Any], *args: Any, **kwargs: Any
    ) -> Any:
        """The sampler's argument."""
        if kwargs.get("noise") is not None:
            raise ValueError(
                "the prior gives noise=: leave it out, and put no second prior around a "
                "policy that has one (warm_smolvla, warm_pi05)"
            )
        image = args[0][0]
        shape = torch.Size((len(image), self.length(policy), self.width(policy)))
        return sample(*args, **kwargs | {"noise": source(shape, torch.float32, image.device)})

    def guiding(self, policy: Any, guide: Callable[[Velocity], Velocity]) -> AbstractContextManager[Any]:
        """These families integrate from 1, the source, to 0: velocities have the other sign."""
        rtc = getattr(policy.config, "rtc_config", None)
        if rtc is not None and rtc.enabled:
            raise ValueError("the policy's own rtc_config guides already: turn it off, or leave out guidance")

        def guided(
            step: Callable[..., Tensor], *args: Any, x_t: Tensor, timestep: Tensor, **kw: Any
        ) -> Tensor:
            def velocity(t: Tensor, a: Tensor) -> Tensor:
                return -step(*args, x_t=a, timestep=1 - t, **kw)

            return -guide(velocity)(1 - timestep, x_t)

        return _replaced(policy, "model.denoise_step", guided)


class GrootPort(FlowPort):
    """For GR00T N1.7."""

    def check(self, policy: Any) -> None:
        """Of relative actions."""
        if getattr(policy.config, "use_relative_actions", False):
            raise ValueError(
                "GR00T's own relative actions (use_relative_actions=True) cannot be expressed at the next "
                "state from outside: train with absolute actions"
            )


class GrootN15Port(FlowPort):
    """For GR00T N1.5, which deviates from its configuration."""

    def check(self, policy: Any) -> None:
        """Of copies of the batch."""
        copies = policy._groot_model.action_head.config.expand_batch
        if copies not in (None, 1):
            raise ValueError(
                f"the action head repeats each batch {copies} times before it draws noise "
                f"(expand_batch={copies}), and the history is not repeated with it: set it to None, and take "
                "a larger batch"
            )

    def normalization(self, policy: Any) -> str:
        """Its preprocessor takes minima and maxima, whatever its ``normalization_mapping``."""
        return "MIN_MAX"

    @contextmanager
    def sampling(self, policy: Any, source: Source, record: Record, nfe: int | None = None) -> Iterator[None]:
        """``select_action`` executes the first actions of a chunk."""

        def predicted(predict: Callable[..., Tensor], *args: Any, **kwargs: Any) -> Tensor:
            # Its queue takes the whole chunk and keeps the last n_action_steps actions.
            return predict(*args, **kwargs)[:, : policy.config.n_action_steps]

        with (
            _replaced(policy, "predict_action_chunk", predicted),
            super().sampling(policy, source, record, nfe),
        ):
            yield


class MultiTaskDiTPort(FlowPort):
    """For multi_task_dit, whose chunk begins with the first of its observations."""

    def lead(self, policy: Any) -> int:
        """Observations before the last one."""
        return policy.config.n_obs_steps - 1

    def check(self, policy: Any) -> None:
        """Of its objective."""
        if policy.config.objective != "flow_matching":
            raise ValueError(
                f"multi_task_dit with objective={policy.config.objective!r} is no flow: set "
                "objective='flow_matching'"
            )

    def predict(self, policy: Any, batch: dict[str, Any]) -> None:
        """Its own ``predict_action_chunk`` takes the observations from its queue."""
        policy.eval()
        if policy.config.n_obs_steps == 1:  # the queue adds a time dimension even to a single one
            seen = policy.config.input_features
            batch = {name: v.unsqueeze(1) if name in seen else v for name, v in batch.items()}
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
"""By the release of LeRobot (``"0.6"`` is all of 0.6), and in it by LeRobot's name of the family.

``"groot"`` is GR00T N1.7 in 0.6, and N1.5 in 0.5.1, whose other families are not supported.
"""


def port_for(policy: Any) -> FlowPort:
    """The port of a policy's family, or of a subclass, in the release of lerobot that is installed."""
    installed = version("lerobot")
    ports = next((PORTS[known] for known in PORTS if f"{installed}.".startswith(f"{known}.")), None)
    supported = "; ".join(f"{release}: {', '.join(known)}" for release, known in PORTS.items())
    if ports is None:
        raise ImportError(
            f"lerobot {installed} is installed, and its policies may draw their noise elsewhere: "
            f"supported are, by release, {supported}"
        )
    names = [getattr(kind, "name", None) for kind in type(policy).__mro__]
    port = next((ports[name] for name in names if name in ports), None)
    if port is None:
        raise ValueError(
            f"{type(policy).__name__} of lerobot {installed} is not supported: supported are, by release, "
            f"{supported}"
        )
    port.check(policy)
    return port
