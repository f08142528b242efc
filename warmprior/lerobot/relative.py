"""Actions relative to the robot's state, expressed relative to a later one."""

from __future__ import annotations

from typing import Any

from torch import Tensor


class RelativeActions:
    """Expresses remembered relative actions at the present state.

    Policies with relative actions (``use_relative_actions``) predict offsets from the state of the decision,
    so a mean from one chunk ago is an offset from where the robot was then.

    Args:
        preprocessor: the policy's pipeline; its step ``RelativeActionsProcessorStep`` holds the raw state of
            the last observation, so the pipeline must have run before each decision.
        postprocessor: the policy's pipeline, which undoes the normalisation.

    Raises:
        ValueError: if the pipelines lack the steps, or have relative actions turned off.

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
            found = [step for step in pipeline.steps if isinstance(step, kind)]
            if not found:
                raise ValueError(f"relative actions need a {kind.__name__} in the pipeline")
            return found[0]

        self._relative = step(preprocessor, RelativeActionsProcessorStep)
        self._normalize = step(preprocessor, NormalizerProcessorStep)
        self._denormalize = step(postprocessor, UnnormalizerProcessorStep)
        if not self._relative.enabled:
            raise ValueError("relative actions are off in the pipeline: leave relative= out")

    def state(self) -> Tensor:
        """Raw state of the last observation, ``[B, d_s]``; a ``ValueError`` if there was none."""
        state = self._relative.get_cached_state()
        if state is None:
            raise ValueError("run the preprocessor before the policy decides: it holds the state")
        # The last of several observations.
        return state.reshape(1, -1) if state.ndim == 1 else state[:, -1] if state.ndim == 3 else state

    def reanchor(self, actions: Tensor, before: Tensor, now: Tensor) -> Tensor:
        """Express actions ``[B, *, d_a]`` relative to one raw state ``[B, d_s]`` relative to another."""
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
