"""A step of the environment below a transform, through the transforms between the two."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase, is_leaf_nontensor, is_non_tensor
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform, TransformedEnv

from warmprior.checks import check_keys
from warmprior.transforms.restarts import NATIVE, Restarts

KEPT = "_kept"
"""The key of observations that :func:`set_aside` keeps, at the root of a step's input."""

GROUP = (
    "groups of agents are not supported: a centralised policy sees and moves all of them as one vector, "
    "after FlattenObservation(-2, -1, [observation], [new key]) and FlattenAction"
)


def check_unwritten(observation_spec: Any, names: Iterable[NestedKey], whose: str) -> None:
    """Raise ValueError if the environment already writes a key that a transform would write."""
    present = observation_spec.keys(True, True)
    if taken := [name for name in names if name in present]:
        raise ValueError(f"{whose} would overwrite {taken}: give each in an environment its own keys")


def check_real(key: NestedKey, action: TensorSpec, before: str) -> None:
    """Raise TypeError for actions of whole numbers or flags, to which a policy's numbers would be cut."""
    if not action.dtype.is_floating_point:  # of MultiDiscrete the width may differ as well
        kind = f"{type(action).__name__} {list(action.shape)} of {action.dtype}"
        raise TypeError(
            f"the environment takes {kind} for {key}, and a policy writes real numbers: append a transform "
            f"before {before} that rounds or encodes them, and writes real numbers into the spec"
        )


class EnvTransform(Transform):
    """A transform that treats resets like steps, and does nothing outside environments."""

    _ends: TensorDictBase | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do nothing: data already hold the transform's entries, or do not need them."""
        return tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # Written to all rows: TorchRL keeps those of the sub-environments that were reset.
        return self._call(tensordict_reset)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        """Begin the new episode of rows that the simulator has restarted; TorchRL merges nothing here."""
        rows = tensordict.get("_reset").view(tensordict.batch_size)
        fresh = self._reset(tensordict, self._as_reset(tensordict_reset.copy()))
        return rows_where(rows, fresh, tensordict_reset)

    def _as_reset(self, stepped: TensorDictBase) -> TensorDictBase:
        """Return a reset's input to this transform, recovered from the result of its step."""
        return stepped

    def _remember_ends(self, next_tensordict: TensorDictBase, names: Iterable[NestedKey]) -> None:
        """Remember this transform's entries: with native autoresets TorchRL blanks observations at an end."""
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
    """A step of the environment below a transform, through the container's own transforms.

    ``Transform.parent`` is the same environment, but with *copies* of the transforms, whose counts and
    records would be lost.
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
        leaves = self.base.observation_spec.items(True, True)
        self.observed = {key: leaf for key, leaf in leaves if key not in states}
        self._done_spec = self.base.full_done_spec
        self._done_shapes = [(key, spec.shape) for key, spec in self._done_spec.items(True, True)]
        inverse = [k for t in before for k in (*t.in_keys_inv, *t.out_keys_inv)]
        self._branches = {key[0] for key in (*inverse, *self.observed) if isinstance(key, tuple)}

    def __call__(
        self, tensordict: TensorDictBase, rows: Tensor | None = None, last: bool = False
    ) -> TensorDictBase:
        """Step all rows, or those in ``rows``, bool ``[*B]``; results of the other rows are undefined.

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
        result = self.base_step(tensordict)
        if rows is not None and self.restarts.native:
            done, ended = (place.get("done").view_as(rows) for place in (result, tensordict))
            if last or not (rows & ~done).any():
                fresh = self.restarts.rows(ended).select(*self.observed, strict=False)
                result = rows_where(ended, result.copy().update(fresh), result)
        for transform in self.transforms:
            result = transform._step(tensordict, result)
        return result

    def base_step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the result of a step ``[*B]`` of the environment itself, with all its flags."""
        # Cloned, because an environment may write the next one into the same memory.
        result = self.base._step(tensordict).clone()
        entries = dict(result.items())  # several times faster to look up
        for key, shape in self._done_shapes:
            done = entries.get(key) if isinstance(key, str) else result.get(key, None)
            if done is None or done.shape != shape:
                # Only if one is missing: most environments return all flags, and completing them is slow.
                self.base._complete_done(self._done_spec, result)
                break
        return result


def set_aside(tensordict: TensorDictBase, observed: Mapping[NestedKey, TensorSpec | None]) -> None:
    """Move observations to :data:`KEPT` during a partial step of a batched environment.

    For rows that it does not step, the environment returns the entries of the step's input, and fails, or
    casts silently, if a transform has changed their shape or dtype. An observation that still fits its spec
    stays: transforms of the workers may read it.
    """
    rows, kept = tensordict.get("_step", None), tensordict.get(KEPT, None)
    if rows is None or not rows.any():
        return  # all rows step, or none, and then TorchRL copies the input
    if kept is None:
        kept = tensordict.empty()
        tensordict.set(KEPT, kept)
    for key, spec in observed.items():
        value = tensordict.get(key, None)
        if value is None or is_non_tensor(value):
            continue
        if spec is None or (value.shape, value.dtype) != (spec.shape, spec.dtype):
            # Entries nested under the key may have been set aside before.
            kept.update(tensordict.select(key))
            tensordict.del_(key)


def observed(tensordict: TensorDictBase, key: NestedKey, whose: str) -> Any:
    """Return an observation in a step's input, possibly :func:`set_aside`; raise KeyError without one."""
    kept = tensordict.get(KEPT, None)
    place = tensordict if kept is None else tensordict.copy().update(kept)
    check_keys(place, [key], whose, ": step with the tensordict that reset or step_mdp returned")
    return place.get(key)


def keep_resting(
    tensordict: TensorDictBase, next_tensordict: TensorDictBase, names: Iterable[NestedKey]
) -> TensorDictBase:
    """Restore a transform's entries in the rows that a partial step has left out, in place."""
    rows = tensordict.get("_step", None)
    for name in names if rows is not None else ():
        before, after = tensordict[name], next_tensordict[name]
        stepped = expand_as_right(rows.view(next_tensordict.batch_size), after)
        next_tensordict.set(name, torch.where(stepped, after, before))
    return next_tensordict


def rows_where(
    mask: Tensor, new: TensorDictBase, old: TensorDictBase, but: Container[NestedKey] = ()
) -> TensorDictBase:
    """Return ``new``, with rows from ``old`` where ``mask`` ``[*B]`` is False and ``old`` has the key.

    Entries in ``but`` stay those of ``new``.
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
    # TorchRL's own `container` skips to the environment, past the Compose that lists earlier transforms.
    reference = transform.__dict__.get("_container")
    return None if reference is None else reference()
