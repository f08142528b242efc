"""A flow policy of LeRobot whose chunks start from a prior."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor

from warmprior.checks import check_between, check_keys, check_shape, check_whole_numbers, given
from warmprior.lerobot.memory import ActionMemory
from warmprior.lerobot.ports import check_no_noise
from warmprior.lerobot.source import ChunkSource
from warmprior.modules.prior import Prior
from warmprior.modules.real_time_chunking import RealTimeChunking, Velocity, spliced


class RelativeActions:
    """A conversion of remembered relative actions to the current state.

    Policies with relative actions (``use_relative_actions``) predict offsets from the state at the decision,
    so a mean from one chunk ago is an offset from the robot's state at that time.

    Args:
        preprocessor: the policy's preprocessing pipeline; its step ``RelativeActionsProcessorStep`` holds the
            raw state of the last observation, so the pipeline must run before each decision.
        postprocessor: the policy's postprocessing pipeline, which undoes the normalisation.

    Raises:
        ValueError: if the pipelines lack the steps, or relative actions are turned off in them.

    Examples:
        >>> from warmprior.lerobot import RelativeActions
        >>> relative = RelativeActions(preprocessor, postprocessor)  # doctest: +SKIP
        >>> _ = preprocessor(observation)  # doctest: +SKIP
        >>> before = relative.state()  # doctest: +SKIP
        >>> relative.reanchor(chunk, before, before + 0.1).sub(chunk).mean()  # std 1  # doctest: +SKIP
        tensor(-0.1000)
    """

    def __init__(self, preprocessor: Any, postprocessor: Any) -> None:
        from lerobot.processor import (
            NormalizerProcessorStep,
            RelativeActionsProcessorStep,
            UnnormalizerProcessorStep,
        )

        def step(pipeline: Any, kind: type) -> Any:
            steps = [step for step in pipeline.steps if isinstance(step, kind)]
            if not steps:
                raise ValueError(f"relative actions need a {kind.__name__} in the pipeline")
            return steps[0]

        self._relative = step(preprocessor, RelativeActionsProcessorStep)
        self._normalize = step(preprocessor, NormalizerProcessorStep)
        self._denormalize = step(postprocessor, UnnormalizerProcessorStep)
        if not self._relative.enabled:
            raise ValueError("relative actions are off in the pipeline: leave relative= out")

    def state(self) -> Tensor:
        """Return the raw state of the last observation, ``[B, d_s]``; raise ValueError without one."""
        state = self._relative.get_cached_state()
        if state is None:
            raise ValueError("run the preprocessor before the policy decides: it holds the state")
        # Of several observations, the last one counts.
        return state.reshape(1, -1) if state.ndim == 1 else state[:, -1] if state.ndim == 3 else state

    def reanchor(self, actions: Tensor, before: Tensor, now: Tensor) -> Tensor:
        """Convert actions ``[B, *, d_a]`` relative to the raw state ``before``, ``[B, d_s]``, to ``now``."""
        from lerobot.processor import (
            TransitionKey,
            create_transition,
            to_absolute_actions,
            to_relative_actions,
        )

        def through(step: Any, value: Tensor) -> Tensor:
            return step(create_transition(action=value))[TransitionKey.ACTION]

        mask = self._relative._build_mask(actions.shape[-1])
        raw = through(self._denormalize, actions)
        moved = to_relative_actions(to_absolute_actions(raw, before, mask), now, mask)
        return through(self._normalize, moved).to(actions)


HISTORY = "action_history"
"""The key of the actions before the current step, if they do not precede ``"action"``."""

HISTORY_IS_PAD = f"{HISTORY}_is_pad"

LEFT_OVER = "prev_chunk_left_over"
"""The name in LeRobot's real-time chunking of the actions that are left of the last chunk."""


def with_width(batch: Mapping[str, Any], widths: Mapping[str, int]) -> dict[str, Any]:
    """Return a batch of windows in which features of width 1 are ``[B, T, 1]``.

    LeRobotDataset returns them as ``[B, T]``.
    """
    short = {n: batch[n] for n, width in widths.items() if width == 1 and n in batch and batch[n].ndim == 2}
    return {**batch, **{name: value.unsqueeze(-1) for name, value in short.items()}}


def history_indices(history_length: int, length: int, lead: int = 0) -> list[int]:
    """Return the dataset steps of a training window, for ``action_delta_indices``.

    Args:
        history_length: number of remembered actions, usually ``H``.
        length: ``T``, the length of the policy's chunk.
        lead: positions of the chunk before the current step.

    Examples:
        >>> from warmprior.lerobot import history_indices
        >>> history_indices(2, 3)
        [-2, -1, 0, 1, 2]
    """
    return list(range(-max(history_length, lead), length - lead))


class WarmPriorAdapter:
    """An adapter that trains and runs an unmodified flow policy of LeRobot from a prior's source.

    It supports pi0, pi0.5, SmolVLA, GR00T N1.7, multi_task_dit (flow matching) and X-VLA of lerobot 0.6, and
    GR00T N1.5 of lerobot 0.5.1. It replaces the noise that loss and sampler draw, exactly once each, or
    raises an error. All values are in the model's own units, after LeRobot's preprocessor and before its
    postprocessor.

    For training, the dataset must return ``H`` more actions before each chunk: set
    ``delta_timestamps["action"]`` to :attr:`action_indices` divided by the frame rate. They are part of
    ``batch["action"]`` ``[B, H + T, d_a]``, and ``batch["action_is_pad"]`` marks those before the episode.
    LeRobot pads these with the episode's first action, i.e. with the target, so they are never used. GR00T's
    preprocessor cuts longer chunks: pass the history as ``"action_history"`` with
    ``"action_history_is_pad"``.

    Args:
        policy: a policy of LeRobot.
        prior: the source distribution. ``H`` is its ``chunk_length``; it may predict fewer actions than
            the policy, whose later positions then start cold.

    Keyword Args:
        std: standard deviation of the data in the model's units, ``[d_a]`` (see :func:`action_std`), if
            ``sigma`` is in units of it, which do not depend on the normalisation; by default ``sigma`` is in
            the normalised action space, as in the paper.
        relative: converts remembered actions to the next state, for policies with relative actions.
        cold_probability: share of the training windows whose history is withheld.
        nfe: integration steps per chunk; the policy's own by default.
        guidance: guides chunks towards the rest of the last one, :class:`~warmprior.RealTimeChunking`, for
            pi0, pi0.5 and SmolVLA; none by default.
        generator: source of randomness on the policy's device; PyTorch's global one by default.

    Raises:
        ValueError: if the family is unknown, or prior, policy and options do not fit each other.
        ImportError: if the installed release of lerobot has no ports.

    Examples:
        >>> from warmprior import PastPrior
        >>> from warmprior.lerobot import WarmPriorAdapter
        >>> adapter = WarmPriorAdapter(policy, PastPrior(50))  # doctest: +SKIP
        >>> loss, _ = adapter.loss(preprocessor(batch))  # doctest: +SKIP
        >>> adapter.reset()  # doctest: +SKIP
        >>> action = postprocessor(adapter.select_action(preprocessor(observation)))  # doctest: +SKIP
    """

    def __init__(
        self,
        policy: Any,
        prior: Prior,
        *,
        std: Tensor | None = None,
        relative: RelativeActions | None = None,
        cold_probability: float = 0.0,
        nfe: int | None = None,
        guidance: RealTimeChunking | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        self.source = ChunkSource(policy, prior, std)
        if getattr(policy, "warm_adapter", None) is not None:
            raise ValueError(f"{type(policy).__name__} has a prior of its own: use policy.warm_adapter")
        self.policy, self.prior, self.generator = policy, prior, generator
        steps = policy.config.n_action_steps
        check_between(1, prior.chunk_length, n_action_steps=steps)  # no more than the prior remembers
        if getattr(policy.config, "use_relative_actions", False) and relative is None:
            raise ValueError(
                "use_relative_actions needs relative=RelativeActions(preprocessor, postprocessor)"
            )
        check_between(0, 1, cold_probability=cold_probability)
        self.cold_probability, self.nfe = cold_probability, nfe
        check_whole_numbers(**given(nfe=nfe))
        self.guidance = guidance
        if guidance is not None:
            self.source.port.guiding(policy, self._guided)  # raises if the policy cannot be guided
        self._relative = relative
        self._memory = ActionMemory(prior, self.source.action_dim)
        # Raw states at the last decision, and at the current one.
        self._state_before: Tensor | None = None
        self._state_now: Tensor | None = None
        self._bypassed = False
        # Control steps until the new chunk takes effect.
        self._delay = 0
        # The number of actions that predict_action_chunk returned last.
        self._returned = 0
        # The last chunk's rest, number of actions left, delay and source width, all over the whole chunk.
        self._guidance_inputs: tuple[Tensor, Tensor, Tensor, Tensor]

    @property
    def action_indices(self) -> list[int]:
        """The :func:`history_indices` of prior and policy."""
        return history_indices(self.prior.history_length, self.source.length, self.source.lead)

    def loss(self, batch: Mapping[str, Any], forward: Callable[..., Any] | None = None, **kwargs: Any) -> Any:
        """Return the policy's own loss and information, with the prior's source.

        Args:
            batch: a preprocessed batch with history, see the class.
            forward: the policy's ``forward`` by default.
            kwargs: arguments of ``forward``.

        Raises:
            KeyError: if ``"action"`` or its mask is missing.
            ValueError: if the window or its mask has another length, or noise is passed.
        """
        check_no_noise(kwargs)
        before, valid, target, is_pad = self._window(with_width(batch, {"action": self.source.action_dim}))
        a0 = self.source.draw_for_training(before, valid, target, self.generator, self.cold_probability)
        inputs = dict(batch)
        for name in (HISTORY, HISTORY_IS_PAD):
            inputs.pop(name, None)
        inputs["action"], inputs["action_is_pad"] = target, is_pad

        def source(shape: torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
            check_shape("the source", a0, shape)
            return a0.to(dtype=dtype, device=device)

        with self.source.port.training(self.policy, source):
            return (self.policy.forward if forward is None else forward)(inputs, **kwargs)

    def select_action(
        self, batch: dict[str, Any], select: Callable[..., Tensor] | None = None, **kwargs: Any
    ) -> Tensor:
        """Return the next action of every environment, ``[B, d_a]``, in the model's units.

        Args:
            batch: a preprocessed observation.
            select: the policy's ``select_action`` by default.
            kwargs: arguments of ``select``.

        Raises:
            ValueError: if the number of environments changes without :meth:`reset`, or guidance has no
                forecast, because ``n_action_steps`` is the whole chunk.
        """
        steps, length = self.policy.config.n_action_steps, self.prior.prediction_length
        if self.guidance is not None and steps >= length:
            raise ValueError(f"guidance needs n_action_steps below the chunk's {length}, got {steps}")
        self._expect(batch)
        with self._from_source():
            action = (self.policy.select_action if select is None else select)(batch, **kwargs)
        self._memory.step()
        return action

    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        executed_steps: int | Tensor | None = None,
        predict: Callable[..., Tensor] | None = None,
        delay: int = 0,
        **kwargs: Any,
    ) -> Tensor:
        """Return a new chunk, ``[B, T', d_a]`` in the model's units, with at most the prior's positions.

        With a delay its first actions are the rest of the last chunk, which is executed in the meantime. The
        arguments of LeRobot's real-time chunking, ``prev_chunk_left_over=`` and ``inference_delay=``, can
        replace ``executed_steps`` and ``delay``.

        Args:
            batch: a preprocessed observation.
            executed_steps: number of executed actions of the last chunk, for all environments that were not
                reset since, or ``[B]``; by default as many as :meth:`select_action` returned.
            predict: the policy's ``predict_action_chunk`` by default.
            delay: control steps until the chunk takes effect.
            kwargs: arguments of ``predict``.

        Raises:
            ValueError: see :meth:`select_action`; also if the number of executed actions is unknown or
                exceeds the chunk, ``prev_chunk_left_over`` is not part of the last chunk, or it is shorter
                than the delay.
        """
        call = self.policy.predict_action_chunk if predict is None else predict
        if self._bypassed:  # on the way from select_action
            return call(batch, **kwargs)
        self._expect(batch)
        if executed_steps is not None:
            self._memory.executed(executed_steps)
        elif LEFT_OVER in kwargs:
            forecast_steps = self._memory.infer_executed(kwargs[LEFT_OVER], self._returned)
            delay = min(kwargs.get("inference_delay") or 0, forecast_steps)
        check_whole_numbers(0, delay=delay)
        self._delay = delay
        try:
            with self._from_source():
                chunk = call(batch, **kwargs)
        finally:
            self._delay = 0
        chunk = self._spliced(chunk)[:, : self.prior.prediction_length]
        self._returned = chunk.shape[1]
        return chunk

    def record_executed(self, action: Tensor) -> None:
        """Replace the last action of :meth:`select_action` by the executed one, for instance after clipping.

        It is ``[B, d_a]`` in the model's units. Raises ValueError if no action was returned yet.
        """
        self._memory.correct(action)

    def reset(self, mask: Tensor | None = None) -> None:
        """Begin new episodes, whose next chunk starts cold, in the environments of a mask, bool ``[B]``.

        By default all environments and the policy are reset. All environments share LeRobot's queue of
        actions, so with a mask the rest of its chunk is still executed.
        """
        self.forget(mask)
        if mask is None:
            self.policy.reset()

    def forget(self, mask: Tensor | None = None) -> None:
        """Begin new episodes as :meth:`reset` does, without resetting the policy."""
        self._memory.forget(mask)

    def _expect(self, batch: Mapping[str, Any]) -> None:
        """Raise ValueError if the number of environments changes, even while LeRobot's queue has actions."""
        state = next((batch[name] for name in ("observation.state", "state") if name in batch), None)
        if state is not None:
            self._memory.expect(len(state))

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Let a policy of the plugin sample as its base class does, without its adapter."""
        before, self._bypassed = self._bypassed, True
        try:
            yield
        finally:
            self._bypassed = before

    @contextmanager
    def _from_source(self) -> Iterator[None]:
        port, guided = self.source.port, self.guidance is not None
        guiding = port.guiding(self.policy, self._guided) if guided else nullcontext()
        with self.aside(), guiding, port.sampling(self.policy, self._source, self._record, self.nfe):
            yield

    def _guided(self, velocity: Velocity) -> Velocity:
        """Return a velocity of the whole chunk, guided towards the forecast of the last one."""
        assert self.guidance is not None
        return self.guidance.guided(velocity, *self._guidance_inputs)

    def _spliced(self, chunk: Tensor) -> Tensor:
        """Return a chunk whose first actions, until it takes effect, are those of the last chunk."""
        forecast, _, delay, _ = self._guidance_inputs
        return spliced(chunk, forecast[:, : chunk.shape[1], : chunk.shape[2]], delay)

    def _window(self, batch: Mapping[str, Any]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        length, history, lead = self.source.length, self.prior.history_length, self.source.lead
        expected = {"action": len(self.action_indices)}
        if HISTORY in batch:
            expected = {"action": length, HISTORY: history}
        needed = [name for key in expected for name in (key, f"{key}_is_pad")]
        check_keys(batch, needed, "the batch", ": set delta_timestamps of the LeRobotDataset")
        lengths = {key: batch[key].shape[1] for key in expected}
        if lengths != expected:
            raise ValueError(
                f"windows have {lengths} actions, expected {expected}: use adapter.action_indices"
            )
        for key in expected:
            check_shape(f"{key}_is_pad", batch[f"{key}_is_pad"], batch[key].shape[:2])
        actions, is_pad = batch["action"], batch["action_is_pad"].bool()
        if HISTORY in batch:
            past, past_is_pad = batch[HISTORY], batch[HISTORY_IS_PAD].bool()
        else:
            past, past_is_pad = (v[:, : max(history, lead)][:, -history:] for v in (actions, is_pad))
        return past, ~past_is_pad, actions[:, -length:], is_pad[:, -length:]

    def _source(self, shape: torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Draw the source of every environment."""
        move = None
        if self._relative is not None:
            relative, before, now = self._relative, self._state_before, self._relative.state()
            self._state_now = now

            def move(actions: Tensor) -> Tensor:
                assert before is not None, "there was a decision, and it had a state"
                return relative.reanchor(actions, before, now)

        history = self._memory.decide(shape[0], device, move)
        source, forecast_steps = self.source.distribution(history), history["forecast_steps"]
        values = source.sample(self.generator), source.scale
        a0, scale = (self.source.scaled(value, source.warm) for value in values)
        delay = torch.where(forecast_steps > 0, self._delay, 0)
        if self._delay and self.source.lead:
            raise ValueError("delay is for policies whose chunk begins at the current step: leave it out")
        going_on = forecast_steps[~self._memory.began]
        if self._delay and len(going_on):
            (self.guidance or RealTimeChunking()).check_reach(self._delay, int(going_on.min()))
        forecast, width = torch.zeros(shape, dtype=dtype, device=device), torch.ones(shape, device=device)
        predicted = (..., self.source.positions, slice(self.source.action_dim))
        forecast[predicted], width[predicted] = history["forecast"].to(dtype), scale
        self._guidance_inputs = forecast, forecast_steps, delay, width
        return self.source.place(a0, self.generator).to(dtype)

    def _record(self, actions: Tensor) -> None:
        self._state_before = self._state_now
        self._memory.record(self._spliced(actions)[:, self.source.positions, : self.source.action_dim])
