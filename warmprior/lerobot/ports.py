"""One small port per family of LeRobot's flow policies: where it draws its noise."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import wraps
from importlib.metadata import version
from typing import Any

import torch
from torch import Tensor

from warmprior.lerobot.injection import Source, SourceInjection

__all__ = ["PORTS", "FlowPort", "check_steps", "port_for"]

Record = Callable[[Tensor], None]
"""Takes what a sampler returned, ``[B, T, >= d_a]``."""


class FlowPort(ABC):
    """Describes a family of policies: the chunk's shape, and where its noise is drawn.

    The policies are not changed. Training and sampling run inside :meth:`training` and :meth:`sampling`,
    which check that the source is used exactly once.

    See Also:
        - :func:`~warmprior.lerobot.port_for`: finds the port of a policy.
        - :data:`~warmprior.lerobot.PORTS`: all of them.

    Examples:
        >>> from warmprior.lerobot import PORTS
        >>> from types import SimpleNamespace
        >>> smolvla = SimpleNamespace(config=SimpleNamespace(chunk_size=50, max_action_dim=32))
        >>> port = PORTS["0.6"]["smolvla"]
        >>> port.length(smolvla), port.width(smolvla), port.lead(smolvla)
        (50, 32, 0)
    """

    @abstractmethod
    def length(self, policy: Any) -> int:
        """``T``, the length of the noisy chunk."""

    @abstractmethod
    def width(self, policy: Any) -> int:
        """``D``, the width of the noisy chunk, with padding beyond the action's."""

    def lead(self, policy: Any) -> int:
        """Positions of the chunk that lie before the current step."""
        return 0

    def normalization(self, policy: Any) -> str | None:
        """How the preprocessor normalises actions, by LeRobot's name: ``"MEAN_STD"``, ``"MIN_MAX"``."""
        return getattr(policy.config.normalization_mapping.get("ACTION"), "value", None)

    @abstractmethod
    def check(self, policy: Any) -> None:
        """Refuse options that would make the source inexact, with a ``ValueError`` that names one."""

    @abstractmethod
    def training(self, policy: Any, source: Source) -> AbstractContextManager[Any]:
        """Context of one ``policy.forward``, whose loss uses this source."""

    @abstractmethod
    def sampling(
        self, policy: Any, source: Source, record: Record, nfe: int | None = None
    ) -> AbstractContextManager[Any]:
        """Context of ``select_action`` or ``predict_action_chunk``: new chunks start from the source.

        ``record`` is called with each chunk, its positions and dimensions of padding.
        """

    def predict(self, policy: Any, batch: dict[str, Any]) -> None:
        """Sample a chunk for a batch of observations, without a queue."""
        policy.predict_action_chunk(batch)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Known ports are pickled and copied by name, because their lambdas cannot be."""
        for release, ports in PORTS.items():
            for name, port in ports.items():
                if port is self:
                    return _known, (release, name)
        return super().__reduce_ex__(protocol)


def _known(release: str, name: str) -> FlowPort:
    return PORTS[release][name]


def check_steps(nfe: int | None) -> None:
    """A ``ValueError`` for a number of integration steps below 1."""
    if nfe is not None and nfe < 1:
        raise ValueError(f"nfe is the number of integration steps: it must be at least 1, got {nfe}")


@contextmanager
def _steps(holder: Any, name: str, nfe: int | None) -> Iterator[None]:
    """Changes the number of integration steps inside the context."""
    before = getattr(holder, name)
    setattr(holder, name, before if nfe is None else nfe)
    try:
        yield
    finally:
        setattr(holder, name, before)


@contextmanager
def _replaced(owner: Any, name: str, around: Callable[[Callable[..., Any]], Any]) -> Iterator[None]:
    """Wraps a method of one instance inside the context."""
    method, before = getattr(owner, name), vars(owner).get(name)
    vars(owner)[name] = wraps(method)(around(method))
    try:
        yield
    finally:
        if before is None:
            del vars(owner)[name]
        else:
            vars(owner)[name] = before


class DrawnPort(FlowPort):
    """For policies that draw their noise with ``torch.randn`` inside a sampler.

    Args:
        length: attribute of the model's configuration.
        width: attribute of its width.
        sampler: ``policy -> (object, name of its method)``.
        steps: ``policy -> (object, name of its attribute)``, the number of integration steps.
        model_config: ``policy -> `` the configuration that the two are read from.
        predicted: what of the sampler's output is the chunk.
        lead: ``policy -> `` positions before the current step.
        check: see :meth:`FlowPort.check`.
        predict: see :meth:`FlowPort.predict`.
    """

    def __init__(
        self,
        length: str,
        width: Callable[[Any], int],
        sampler: Callable[[Any], tuple[Any, str]],
        steps: Callable[[Any], tuple[Any, str]],
        *,
        model_config: Callable[[Any], Any] = lambda policy: policy.config,
        predicted: Callable[[Any], Tensor] = lambda output: output,
        lead: Callable[[Any], int] = lambda policy: 0,
        check: Callable[[Any], None] = lambda policy: None,
        predict: Callable[[Any, dict[str, Any]], Any] = (
            lambda policy, batch: policy.predict_action_chunk(batch)
        ),
    ) -> None:
        self._length, self._width, self._sampler = length, width, sampler
        self._steps, self._predict = steps, predict
        self._model_config, self._predicted = model_config, predicted
        self._lead, self._check = lead, check

    def length(self, policy: Any) -> int:
        """``T``."""
        return int(getattr(self._model_config(policy), self._length))

    def width(self, policy: Any) -> int:
        """``D``."""
        return int(self._width(policy))

    def lead(self, policy: Any) -> int:
        """Observations before the last one, as the chunk begins with the first."""
        return self._lead(policy)

    def check(self, policy: Any) -> None:
        """See :meth:`FlowPort.check`."""
        self._check(policy)

    def training(self, policy: Any, source: Source) -> AbstractContextManager[Any]:
        """The draw in the loss."""
        return SourceInjection(self.length(policy), self.width(policy), source)

    def predict(self, policy: Any, batch: dict[str, Any]) -> None:
        """See :meth:`FlowPort.predict`."""
        self._predict(policy, batch)

    @contextmanager
    def sampling(self, policy: Any, source: Source, record: Record, nfe: int | None = None) -> Iterator[None]:
        """The draw in the sampler."""

        def around(sample: Callable[..., Any]) -> Callable[..., Any]:
            def sampled(*args: Any, **kwargs: Any) -> Any:
                with SourceInjection(self.length(policy), self.width(policy), source):
                    output = sample(*args, **kwargs)
                record(self._predicted(output))
                return output

            return sampled

        with _steps(*self._steps(policy), nfe), _replaced(*self._sampler(policy), around):
            yield


class GrootN15Port(DrawnPort):
    """For GR00T N1.5, which deviates from its configuration."""

    def normalization(self, policy: Any) -> str:
        """Its preprocessor takes minima and maxima, whatever its ``normalization_mapping``."""
        return "MIN_MAX"

    @contextmanager
    def sampling(self, policy: Any, source: Source, record: Record, nfe: int | None = None) -> Iterator[None]:
        """The draw in the sampler; ``select_action`` executes the first actions of a chunk."""

        def around(predict: Callable[..., Tensor]) -> Callable[..., Tensor]:
            def predicted(*args: Any, **kwargs: Any) -> Tensor:
                # Its queue takes the whole chunk and keeps the last n_action_steps actions.
                return predict(*args, **kwargs)[:, : policy.config.n_action_steps]

            return predicted

        with _replaced(policy, "predict_action_chunk", around), super().sampling(policy, source, record, nfe):
            yield


class OpenPiPort(FlowPort):
    """For pi0, pi0.5 and SmolVLA, whose models take the noise as an argument (compiled ones too)."""

    def length(self, policy: Any) -> int:
        """``T``."""
        return int(policy.config.chunk_size)

    def width(self, policy: Any) -> int:
        """``D``."""
        return int(policy.config.max_action_dim)

    def check(self, policy: Any) -> None:
        """See :meth:`FlowPort.check`."""
        if getattr(policy.config, "adapt_to_pi_aloha", False):
            raise ValueError(
                "adapt_to_pi_aloha=True gives actions in another space than the model's, so the source "
                "would have the wrong mean: convert the dataset instead, and turn it off"
            )

    @contextmanager
    def training(self, policy: Any, source: Source) -> Iterator[None]:
        """The model's argument."""
        signature, calls = inspect.signature(type(policy.model).forward), []

        def around(forward: Callable[..., Any]) -> Callable[..., Any]:
            def from_source(*args: Any, **kwargs: Any) -> Any:
                bound = signature.bind(policy.model, *args, **kwargs)
                actions = bound.arguments["actions"]
                calls.append(actions.shape)
                bound.arguments["noise"] = source(actions.shape, torch.float32, actions.device)
                return forward(*bound.args[1:], **bound.kwargs)

            return from_source

        with _replaced(policy.model, "forward", around):
            yield
        if len(calls) != 1:
            raise RuntimeError(
                f"{type(policy).__name__} evaluated its model {len(calls)} times in one loss, not once: its "
                "source cannot be replaced. Use the version of lerobot that this port is for"
            )

    @contextmanager
    def sampling(self, policy: Any, source: Source, record: Record, nfe: int | None = None) -> Iterator[None]:
        """The sampler's argument."""
        length, width = self.length(policy), self.width(policy)

        def around(sample: Callable[..., Any]) -> Callable[..., Any]:
            def sampled(images: Any, *args: Any, **kwargs: Any) -> Tensor:
                if kwargs.get("noise") is not None:
                    raise ValueError(
                        "the prior gives noise=: leave it out, and put no second prior around a "
                        "policy that has one (warm_smolvla, warm_pi05)"
                    )
                shape = torch.Size((images[0].shape[0], length, width))
                kwargs["noise"] = source(shape, torch.float32, images[0].device)
                actions = sample(images, *args, **kwargs)
                record(actions)
                return actions

            return sampled

        # SmolVLA calls it by another name.
        steps = "num_steps" if hasattr(policy.config, "num_steps") else "num_inference_steps"
        with _steps(policy.config, steps, nfe), _replaced(policy.model, "sample_actions", around):
            yield


def _check_groot(policy: Any) -> None:
    if getattr(policy.config, "use_relative_actions", False):
        raise ValueError(
            "GR00T's own relative actions (use_relative_actions=True) cannot be expressed at the next "
            "state from outside: train with absolute actions"
        )


def _check_groot_n15(policy: Any) -> None:
    copies = policy._groot_model.action_head.config.expand_batch
    if copies not in (None, 1):
        raise ValueError(
            f"the action head repeats each batch {copies} times before it draws noise "
            f"(expand_batch={copies}), and the history is not repeated with it: set it to None, and take "
            "a larger batch"
        )


def _check_multi_task_dit(policy: Any) -> None:
    if policy.config.objective != "flow_matching":
        raise ValueError(
            f"multi_task_dit with objective={policy.config.objective!r} is no flow: set "
            "objective='flow_matching'"
        )


def _predict_multi_task_dit(policy: Any, batch: dict[str, Any]) -> None:
    # Its own predict_action_chunk takes the observations from its queue.
    policy.eval()
    if policy.config.n_obs_steps == 1:  # the queue adds a time dimension even to a single one
        seen = policy.config.input_features
        batch = {name: v.unsqueeze(1) if name in seen else v for name, v in batch.items()}
    with torch.no_grad():
        policy._generate_actions(policy._prepare_batch(batch))


_openpi = OpenPiPort()

PORTS: dict[str, dict[str, FlowPort]] = {
    "0.6": {
        "pi0": _openpi,
        "pi05": _openpi,
        "smolvla": _openpi,
        "groot": DrawnPort(
            "action_horizon",
            lambda policy: policy._groot_model.config.max_action_dim,
            lambda policy: (policy._groot_model.action_head, "get_action_with_features"),
            lambda policy: (policy._groot_model.action_head, "num_inference_timesteps"),
            model_config=lambda policy: policy._groot_model.config,
            predicted=lambda output: output["action_pred"],
            check=_check_groot,
        ),
        "multi_task_dit": DrawnPort(
            "horizon",
            lambda policy: policy.config.action_feature.shape[0],
            lambda policy: (policy.objective, "conditional_sample"),
            lambda policy: (policy.objective.config, "num_integration_steps"),
            lead=lambda policy: policy.config.n_obs_steps - 1,
            check=_check_multi_task_dit,
            predict=_predict_multi_task_dit,
        ),
        "xvla": DrawnPort(
            "chunk_size",
            lambda policy: policy.model.dim_action,
            lambda policy: (policy.model, "generate_actions"),
            lambda policy: (policy.config, "num_denoising_steps"),
        ),
    },
    "0.5.1": {
        "groot": GrootN15Port(
            "action_horizon",
            lambda policy: policy._groot_model.action_head.config.action_dim,
            lambda policy: (policy._groot_model.action_head, "get_action"),
            lambda policy: (policy._groot_model.action_head, "num_inference_timesteps"),
            model_config=lambda policy: policy._groot_model.action_head.config,
            predicted=lambda output: output["action_pred"],
            check=_check_groot_n15,
        )
    },
}
"""By the release of LeRobot (``"0.6"`` is all of 0.6), and in it by LeRobot's name of the family.

``"groot"`` is GR00T N1.7 in 0.6, and N1.5 in 0.5.1, whose other families are not supported.
"""


def port_for(policy: Any) -> FlowPort:
    """The port of a policy's family, or of a subclass, in the release of lerobot that is installed.

    Raises:
        ValueError: if there is none, or it does not support the policy's options.
        ImportError: if there is none for this release.

    See Also:
        - :class:`~warmprior.lerobot.FlowPort`: what it returns.
        - :data:`~warmprior.lerobot.PORTS`: all of them.

    Examples:
        >>> from warmprior.lerobot import port_for
        >>> port_for(policy).length(policy)  # a SmolVLAPolicy  # doctest: +SKIP
        50
        >>> class ACTPolicy:
        ...     name = "act"  # no flow
        >>> port_for(ACTPolicy())
        Traceback (most recent call last):
            ...
        ValueError: ACTPolicy of lerobot ... is not supported: supported are, by release, 0.6: pi0, pi05, ...
    """
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
