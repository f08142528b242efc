"""Transforms that can wait until the end of a chunk, because only its last control steps matter."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import ActionScaling, ObservationNorm, Transform, TransformedEnv

from warmprior import keys
from warmprior.transforms.absolute_actions import AbsoluteActions
from warmprior.transforms.images import CameraImages
from warmprior.transforms.inner_step import InnerStep
from warmprior.transforms.stack import ObservationStack

__all__ = ["LateTransforms", "advance"]

_REACH: dict[type[Transform], Callable[[Any], int]] = {
    AbsoluteActions: lambda transform: 1,
    ActionScaling: lambda transform: 1,
    CameraImages: lambda transform: 1,
    ObservationNorm: lambda transform: 1,
    ObservationStack: lambda transform: transform.steps,
}
"""Transforms without memory, by type: how many of the last observations their output depends on."""


class LateTransforms:
    """Runs control steps first, and their transforms afterwards, for the steps that count.

    A decision of ``k`` control steps is read once, at its end. Transforms such as :class:`ObservationStack`
    would transform all of its observations only to discard most of them, which costs more than anything else
    here beside a fast simulator. The result equals that of transforming every step, bit by bit.

    An environment without batch dimensions may offer ``control_steps(actions, keep)``, as
    :class:`~warmprior.envs.RobosuiteEnv` does, which takes all steps in one call. It is used where
    actions can be inverted at once and only reward and flags of the first steps are read (``brief``), and
    doubles the speed.
    """

    def __init__(self, step: InnerStep, brief: bool) -> None:
        self._step = step
        self._transforms = step.transforms
        self._reach = 1 + sum(_REACH[type(t)](t) - 1 for t in self._transforms)
        # Actions are inverted from the last transform to the first: those after the last one that looks at
        # the state can take all of them at once.
        looking = (i for i, t in enumerate(self._transforms) if isinstance(t, AbsoluteActions))
        first = 1 + max(looking, default=-1)
        self._one_by_one, self._at_once = self._transforms[:first], self._transforms[first:]
        self._control_steps: Callable[[Tensor, int], list[TensorDictBase]] | None = None
        if brief and not self._one_by_one and not step.base.batch_size:
            self._control_steps = _control_steps(step.base)

    @classmethod
    def of(cls, step: InnerStep, read: Iterable[NestedKey]) -> LateTransforms | None:
        """Such steps, or ``None`` where ``read`` needs every transform to run at every step."""
        transforms, base = step.transforms, step.base
        # An environment reads its action and states alone: other observations may reach it untransformed.
        # A transformed one has transforms of its own, which may read what these write.
        if isinstance(base, TransformedEnv) or any(type(t) not in _REACH for t in transforms):
            return None
        written = _roots(key for t in transforms for key in t.out_keys)
        looked_at = [keys.EEF_POSE for t in transforms if isinstance(t, AbsoluteActions)]
        needed = _roots([keys.ACTION, *read, *looked_at, *base.state_spec.keys(True, True)])
        inverse = [(list(t.in_keys_inv), list(t.out_keys_inv)) for t in transforms]
        if written & needed or any(ends not in ([], [keys.ACTION]) for pair in inverse for ends in pair):
            return None
        brief = {*base.reward_keys, *base.done_keys, keys.SUCCESS}
        return cls(step, brief.issuperset(read))

    def __call__(
        self, current: dict[str, Any], first: TensorDictBase, actions: Tensor, reward_key: NestedKey
    ) -> list[TensorDictBase]:
        """Take steps with actions ``[*B, n, d_a]`` after ``first`` until an environment is done; all results.

        ``current`` becomes the input of the last one in place; only what that led to is transformed.
        """
        results, actions = [first], self._inverse(actions)
        if self._control_steps is None:
            results += self._steps(current, first, actions, reward_key)
        elif len(actions) and not first.get("done").any():
            results += self._control_steps(actions, self._reach)
        if len(results) > 1:
            results[-1] = self._transformed(first, results[1:])
        return results

    def _steps(
        self, current: dict[str, Any], first: TensorDictBase, actions: Tensor, reward_key: NestedKey
    ) -> list[TensorDictBase]:
        """One step after the other, untransformed."""
        results: list[TensorDictBase] = []
        for action in actions.unbind(0):
            advance(current, results[-1] if results else first, reward_key)
            if current["done"].any():
                break
            # Without the constructor's checks: the entries come out of tensordicts of this batch size.
            entries = current | {keys.ACTION: action}
            inputs = TensorDict._new_unsafe(entries, batch_size=first.batch_size, device=first.device)
            for transform in reversed(self._one_by_one):
                inputs = transform._inv_call(inputs)
            results.append(self._step.bare(inputs))
        return results

    def _inverse(self, actions: Tensor) -> Tensor:
        # Elementwise: all of them at once, time first, so that what a transform has per row broadcasts.
        actions = actions.movedim(-2, 0)
        for transform in reversed(self._at_once):
            if transform.in_keys_inv:
                actions = transform._inv_apply_transform(actions)
        return actions

    def _transformed(self, before: TensorDictBase, results: list[TensorDictBase]) -> TensorDictBase:
        # What lies further back than they reach has no influence, so that `before` may be older.
        for result in results[-self._reach :]:
            for transform in self._transforms:
                result = transform._step(before, result)
            before = result
        return before


def _control_steps(base: EnvBase) -> Callable[[Tensor, int], list[TensorDictBase]] | None:
    """That of an environment whose ``_step`` is the one that it goes with: a subclass may have another."""
    owner = next((cls for cls in type(base).__mro__ if "control_steps" in vars(cls)), None)
    same = owner is not None and type(base)._step is owner._step  # type: ignore[attr-defined]
    return getattr(base, "control_steps", None) if same else None


def advance(current: dict[str, Any], next_tensordict: TensorDictBase, reward_key: NestedKey) -> None:
    """A lean ``step_mdp``, in place and without the reward: it runs at every control step."""
    for key, value in next_tensordict.items():
        # The type first: nearly all are plain tensors, and the instance check is slow.
        if type(value) is not Tensor and isinstance(value, TensorDictBase) and key in current:
            value = current[key].copy().update(value)
        if key != reward_key:
            current[key] = value


def _roots(names: Iterable[NestedKey]) -> set[str]:
    return {name if isinstance(name, str) else name[0] for name in names}
