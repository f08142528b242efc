"""A step of the environment below a transform, through the transforms that its container already holds."""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import Any

import torch
from tensordict import TensorDictBase, is_leaf_nontensor, is_non_tensor
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform, TransformedEnv

from warmprior.transforms.restarts import NATIVE, Restarts

KEPT = "_kept"
"""Where :func:`set_aside` puts observations, at the root of a step's input."""


def check_unwritten(observation_spec: Any, names: Iterable[NestedKey], whose: str) -> None:
    """Raise ValueError if something before a transform writes what it is about to write."""
    present = observation_spec.keys(True, True)
    if taken := [name for name in names if name in present]:
        raise ValueError(f"{whose} would overwrite {taken}: each needs keys of its own in one environment")


class EnvTransform(Transform):
    """A transform that writes the same after a reset as after a step, and nothing outside environments."""

    _ends: TensorDictBase | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Does nothing: what the transform writes is already in data, or not needed there."""
        return tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # For all sub-environments: TorchRL keeps the rows of those that were reset.
        return self._call(tensordict_reset)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        """Begin the new episode of rows that the simulator has restarted; TorchRL merges nothing here."""
        rows = tensordict.get("_reset").view(tensordict.batch_size)
        fresh = self._reset(tensordict, self._as_reset(tensordict_reset.copy()))
        return rows_where(rows, fresh, tensordict_reset)

    def _as_reset(self, stepped: TensorDictBase) -> TensorDictBase:
        """Return what a reset would give to this transform, from what its step has made of it."""
        return stepped

    def _remember_ends(self, next_tensordict: TensorDictBase, names: Iterable[NestedKey]) -> None:
        """Remember what was written: with native autoresets TorchRL blanks all observations of an end."""
        if self.parent.__dict__.get(NATIVE, False):
            self._ends = next_tensordict.select(*names, strict=False).copy()

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        if self._ends is not None:
            tensordict.get("next").update(self._ends)
            self._ends = None
        return tensordict, tensordict_


class InnerStep:
    """Steps the environment that a transform sees below itself, through the container's own transforms.

    ``Transform.parent`` is that environment too, but around *copies*: what they count or record would be
    lost.
    """

    def __init__(self, transform: Transform) -> None:
        before: list[Transform] = []
        child, container = transform, _container(transform)
        while isinstance(container, Compose):
            siblings = list(container.transforms)
            position = next(i for i, sibling in enumerate(siblings) if sibling is child)
            before = siblings[:position] + before
            child, container = container, _container(container)
        if not isinstance(container, TransformedEnv):
            raise RuntimeError(
                f"{type(transform).__name__} only steps environments: append it to a TransformedEnv"
            )
        self.base: EnvBase = container.base_env
        self.transforms = before
        self.restarts = Restarts(container, before)
        states = set(self.base.state_spec.keys(True, True))
        self.observed = [key for key in self.base.observation_spec.keys(True, True) if key not in states]
        done_spec = self.base.full_done_spec
        self._done_spec = done_spec
        self._done_shapes = [(key, spec.shape) for key, spec in done_spec.items(True, True)]
        inverse = [k for t in before for k in (*t.in_keys_inv, *t.out_keys_inv)]
        self._branches = {key[0] for key in (*inverse, *self.observed) if isinstance(key, tuple)}

    def __call__(
        self, tensordict: TensorDictBase, rows: Tensor | None = None, last: bool = False
    ) -> TensorDictBase:
        """Take the step of all rows, or of those in ``rows``, bool ``[*B]``; the others are undefined.

        After the ``last`` step of a decision, rows that a simulator has restarted show a fresh reset.
        """
        if rows is not None and self.restarts.needed:
            self.restarts.rows(tensordict.get("done").view_as(rows))
        for branch in self._branches:
            if branch in tensordict:
                tensordict.set(branch, tensordict.get(branch).copy())
        if rows is not None and self.base.batch_locked:
            tensordict.set("_step", rows)
            set_aside(tensordict, self.observed)
        for transform in reversed(self.transforms):
            tensordict = transform._inv_call(tensordict)
        result = self.bare(tensordict)
        if rows is not None and self.restarts.native:
            done, ended = (place.get("done").view_as(rows) for place in (result, tensordict))
            if last or not (rows & ~done).any():
                fresh = self.restarts.rows(ended).select(*self.observed, strict=False)
                result = rows_where(ended, result.copy().update(fresh), result)
        for transform in self.transforms:
            result = transform._step(tensordict, result)
        return result

    def bare(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The result of a step ``[*B]`` of the environment itself, with all its flags."""
        # Cloned, because an environment may write the next one into the same memory.
        result = self.base._step(tensordict).clone()
        found = dict(result.items())  # several times faster to ask
        for key, shape in self._done_shapes:
            done = found.get(key) if isinstance(key, str) else result.get(key, None)
            if done is None or done.shape != shape:
                # Only then: most environments give all flags, and completing them is slow.
                self.base._complete_done(self._done_spec, result)
                break
        return result


def set_aside(tensordict: TensorDictBase, observed: Iterable[NestedKey]) -> None:
    """Keep observations, under :data:`KEPT`, from a batched environment that takes a partial step.

    For the rows that it leaves out it returns what it finds in the step's input, and fails, or casts
    silently, if a transform gave that another shape or dtype.
    """
    rows, kept = tensordict.get("_step", None), tensordict.get(KEPT, None)
    if rows is None or not rows.any():
        return  # all step, or none: then TorchRL copies what it finds
    if kept is None:
        kept = tensordict.empty()
        tensordict.set(KEPT, kept)
    for key in observed:
        value = tensordict.get(key, None)
        if value is not None and not is_non_tensor(value):
            # Entries nested under the key may have been set aside before.
            kept.update(tensordict.select(key))
            tensordict.del_(key)


def keep_resting(
    tensordict: TensorDictBase, next_tensordict: TensorDictBase, names: Iterable[NestedKey]
) -> TensorDictBase:
    """After a partial step, restore what a transform wrote in the rows that were not stepped, in place."""
    rows = tensordict.get("_step", None)
    for name in names if rows is not None else ():
        before, after = tensordict[name], next_tensordict[name]
        asked = expand_as_right(rows.view(next_tensordict.batch_size), after)
        next_tensordict.set(name, torch.where(asked, after, before))
    return next_tensordict


def rows_where(
    mask: Tensor, new: TensorDictBase, old: TensorDictBase, but: Container[NestedKey] = ()
) -> TensorDictBase:
    """``new``, with the rows of ``old`` where ``mask`` ``[*B]`` does not hold and ``old`` has the key.

    Entries ``but`` some, which stay those of ``new``.
    """
    result = new.copy()
    for key in new.keys(True, True, is_leaf=is_leaf_nontensor):
        previous = None if key in but else old.get(key, None)
        if previous is not None:
            value = new.get(key)
            rows = mask if is_non_tensor(value) else expand_as_right(mask, value)
            result.set(key, torch.where(rows, value, previous))
    return result


def _container(transform: Transform) -> EnvBase | Compose | None:
    # TorchRL's own `container` skips to the environment, but what comes before is listed on the way.
    reference = transform.__dict__.get("_container")
    return None if reference is None else reference()
