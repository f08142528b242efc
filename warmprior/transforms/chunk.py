"""Execution of action chunks in an environment, exact at every episode end."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import dropwhile
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase, is_non_tensor, is_tensor_collection
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.transforms import (
    ActionDiscretizer,
    ActionScaling,
    ConditionalPolicySwitch,
    ConditionalSkip,
    FrameSkipTransform,
    ObservationNorm,
    Transform,
    TransformedEnv,
)

from warmprior import keys
from warmprior.checks import check_between, check_choice, check_keys, check_whole_numbers
from warmprior.transforms.absolute_actions import AbsoluteActions
from warmprior.transforms.images import CameraImages
from warmprior.transforms.inner_step import GROUP, EnvTransform, InnerStep, rows_where, set_aside
from warmprior.transforms.normalize import FloatNorm, FloatScaling
from warmprior.transforms.restarts import flat
from warmprior.transforms.stack import ObservationStack

Combination = Literal["max", "sum", "last"]

Measures = Mapping[str, Combination]
"""A mapping from an environment's keys to the way in which a chunk, and an episode, combine their values."""


def check_measures(measures: Measures) -> None:
    """Raise an error if it is not said how a measure's values are combined, or an unknown way is named."""
    if not isinstance(measures, Mapping):
        raise TypeError(
            f"measures must say how each is combined, as {{'reward': 'max'}} does, got {measures}"
        )
    for key, how in measures.items():
        check_choice(f"the measure {key!r}", how, get_args(Combination))


_PER_STEP = {AbsoluteActions, ActionScaling, CameraImages, FloatNorm, FloatScaling, ObservationNorm}
"""The transforms whose output depends on the last step alone; a stack's depends on all that it holds."""

_REFUSED: dict[type[Transform], str] = {
    ActionDiscretizer: "whose actions are indices, and those of chunks numbers: leave it out",
    ConditionalPolicySwitch: "which acts within a chunk, unseen by the history: append it after",
    ConditionalSkip: "which skips single steps of a chunk: append it after, where it skips decisions",
}

_INSIDE: dict[type[Transform], str] = {
    ConditionalSkip: "would skip chunks, which their executed steps do not show: append it inside, after it",
    FrameSkipTransform: "would repeat chunks, of which the history sees one: append it inside, before it",
}
"""The transforms that have to be in the same environment as :class:`ChunkStep`."""


def _descriptions(env: EnvBase) -> list[str]:
    """Return what an environment says of itself; of workers in other processes nothing else is known."""
    if not isinstance(env, BatchedEnvBase):
        return [repr(env)]
    workers = env.meta_data if isinstance(env.meta_data, list) else [env.meta_data]
    return [worker.env_str for worker in workers]


def _acts_as(part: Transform, kind: type[Transform]) -> bool:
    """Return True if a transform is of a kind and does anything: a ``FrameSkipTransform(1)`` does not."""
    # A subclass may repeat in its own way.
    idle = type(part) is FrameSkipTransform and part.frame_skip == 1
    return isinstance(part, kind) and not idle


def check_outside(env: EnvBase) -> None:
    """Raise RuntimeError if a transform outside of environments with :class:`ChunkStep` belongs inside.

    From inside, such as in a worker, it cannot be seen.
    """
    while isinstance(env, TransformedEnv):
        parts, env = list(flat(env.transform)), env.base_env
        inside = any("ChunkStep(" in text for text in _descriptions(env))
        for kind, why in _INSIDE.items() if inside else ():
            if any(_acts_as(part, kind) for part in parts):
                raise RuntimeError(f"{kind.__name__} outside of the environment with ChunkStep {why}")


class LateTransforms:
    """A loop that runs all control steps first, and then the transforms of the steps that are read.

    A decision of ``k`` control steps is read once, at its end; with a fast simulator, transforming all
    observations only to discard most of them would take most of the time. The result equals that of
    transforming every step, bit for bit.
    """

    def __init__(self, step: InnerStep, action_key: NestedKey) -> None:
        self._step, self._action_key = step, action_key
        self._transforms = step.transforms
        stacks = (t for t in self._transforms if isinstance(t, ObservationStack))
        self._reach = 1 + sum(stack.steps - 1 for stack in stacks)
        # Actions are inverted from the last transform to the first.
        self._inverse = [t for t in reversed(self._transforms) if t.in_keys_inv]

    @classmethod
    def of(
        cls, step: InnerStep, read: Iterable[NestedKey], action_keys: Sequence[NestedKey]
    ) -> LateTransforms | None:
        """Return such a loop, or ``None`` if ``read`` needs every transform to run at every step."""
        transforms, base = step.transforms, step.base
        (action_key, *others) = action_keys
        # The lean loop sets one entry at the root. The own transforms of a transformed environment may read
        # entries that these transforms write.
        if others or isinstance(action_key, tuple) or isinstance(base, TransformedEnv):
            return None
        if not {type(transform) for transform in transforms} <= {*_PER_STEP, ObservationStack}:
            return None
        # An environment reads only its action and states: other observations may reach it untransformed.
        written = _roots(key for t in transforms for key in t.out_keys)
        looked_at = [keys.EEF_POSE for t in transforms if isinstance(t, AbsoluteActions)]
        needed = _roots([action_key, *read, *looked_at, *base.state_spec.keys(True, True)])
        inverse = [(list(t.in_keys_inv), list(t.out_keys_inv)) for t in transforms]
        if written & needed or any(ends not in ([], [action_key]) for pair in inverse for ends in pair):
            return None
        return cls(step, action_key)

    def __call__(
        self, current: dict[str, Any], first: TensorDictBase, actions: Tensor, reward_key: NestedKey
    ) -> list[TensorDictBase]:
        """Return the results of ``first`` and actions ``[*B, n, d_a]`` until an environment is done.

        ``current`` becomes the input of the last step, in place; only that step's result is transformed.
        """
        results = [first]
        for action in actions.unbind(-2):
            update_input(current, results[-1], reward_key)
            if current["done"].any():
                break
            # The constructor's checks are skipped: all entries come from tensordicts of this batch size.
            entries = current | {self._action_key: action}
            inputs = TensorDict._new_unsafe(entries, batch_size=first.batch_size, device=first.device)
            for transform in self._inverse:
                inputs = transform._inv_call(inputs)
            results.append(self._step.base_step(inputs))
        if len(results) > 1:
            results[-1] = self._transformed(first, results[1:])
        return results

    def _transformed(self, before: TensorDictBase, results: list[TensorDictBase]) -> TensorDictBase:
        # Results further back than the transforms reach have no influence, so `before` may be older.
        for result in results[-self._reach :]:
            for transform in self._transforms:
                result = transform._step(before, result)
            before = result
        return before


def update_input(current: dict[str, Any], next_tensordict: TensorDictBase, reward_key: NestedKey) -> None:
    """Move a step's result into ``current``: a lean ``step_mdp``, in place and without the reward."""
    for key, value in next_tensordict.items():
        # The type is compared first: nearly all are plain tensors, and the instance check is slow.
        if (
            type(value) is not Tensor
            and is_tensor_collection(value)
            and not is_non_tensor(value)
            and key in current
        ):
            value = current[key].copy().update(value)
        if key != reward_key:
            current[key] = value


def _roots(names: Iterable[NestedKey]) -> set[str]:
    return {name if isinstance(name, str) else name[0] for name in names}


class ChunkStep(EnvTransform):
    r"""A transform that lets a single-action environment take action chunks (a semi-MDP).

    One outer step executes the first ``execute`` actions of a chunk ``[*B, P, d_a]``, and stops each
    sub-environment at the end of its own episode. The reward is the discounted sum :math:`\sum_{i<k} \gamma^i
    r_i` over the ``k`` executed steps, and ``("next", "executed_steps")`` is ``k``. All other entries, except
    ``success`` and ``measures``, come from the last executed step. Unlike
    :class:`~torchrl.envs.transforms.MultiAction` it keeps the last reward of an episode that ends inside a
    chunk, and works inside and outside batched environments.

    Append it after per-step transforms (``StepCounter``, ``RewardSum``, ``ActionScaling``, ``CatFrames``,
    ``VideoRecorder``) and before per-decision ones (:class:`ActionHistory`, ``InitTracker``). If all per-step
    transforms are memoryless (``ObservationNorm``, ``ActionScaling``, :class:`ObservationStack`), they
    run only at the steps that a chunk's last observation depends on. In a partial step, rows that are not
    stepped keep all observations.

    .. note::
        Around a batched environment, TorchRL's transforms with memory, such as ``CatFrames`` or
        ``VecNormV2``, update that memory in all rows, including those that a partial step leaves out. If rows
        may skip steps after a reset, place such transforms inside the workers. :class:`ObservationStack` has
        no such memory.

    .. note::
        What is outside of the environment, around workers that have this transform, cannot be seen from
        here: a ``FrameSkipTransform`` there would repeat whole chunks, and a ``ConditionalSkip`` leave
        ``"executed_steps"`` as it was. :func:`~warmprior.evaluation.evaluate` refuses both.

    Args:
        chunk_length: ``H``.
        execute: number of actions of a chunk that are executed before the next decision; ``H`` by default.
        prediction_length: ``P``, the length of the policy's chunks; ``H`` by default.
        gamma: discount per control step.
        success: key of a bool flag that is True after a chunk if it was True after any of its executed steps;
            ignored if the environment does not write it.
        by_success: True rewards a control step with 1 if that flag is True then, and with 0 otherwise, in
            place of the environment's own reward.
        measures: further keys (no states), each with ``"max"``, ``"sum"`` or ``"last"``: how its values over
            the executed steps become one per chunk. Sums of flags and whole numbers are int64.
        action_keys: keys of the environment's actions, vectors ``[*B, d_a]``.
        chunk_keys: keys of the chunks that replace them, ``[*B, P, d_a]``. Policies that act in the same
            environment need different keys.

    Raises:
        ValueError: if not ``1 <= execute <= chunk_length <= prediction_length``, ``gamma`` is not in [0, 1],
            an action is not a vector, a measure is combined in another way, or there are not as many chunk
            keys as action keys.
        KeyError: if ``action_keys`` are not exactly the environment's actions, or it lacks the success that
            is to be its reward.
        RuntimeError: (at the first reset) if the environment has several rewards or no root ``"done"``, skips
            single steps, or restarts rows by itself so that the rest of a chunk would be executed in the next
            episode.

    Examples:
        >>> from torchrl.envs import Compose, GymEnv, StepCounter, TransformedEnv
        >>> from warmprior import ChunkStep
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(StepCounter(max_steps=10), ChunkStep(4)))
        >>> rollout = env.rollout(5)
        >>> rollout["vla_action", "chunk"].shape  # 10 control steps are 3 decisions
        torch.Size([3, 4, 1])
        >>> rollout["next", "executed_steps"].flatten().tolist()
        [4, 4, 2]
    """

    def __init__(
        self,
        chunk_length: int,
        *,
        execute: int | None = None,
        prediction_length: int | None = None,
        gamma: float = 1.0,
        success: NestedKey = keys.SUCCESS,
        by_success: bool = False,
        measures: Measures | None = None,
        action_keys: Sequence[NestedKey] = (keys.ACTION,),
        chunk_keys: Sequence[NestedKey] = (keys.CHUNK,),
    ) -> None:
        super().__init__(
            in_keys_inv=[unravel_key(key) for key in action_keys],
            out_keys_inv=[unravel_key(key) for key in chunk_keys],
        )
        if not len(action_keys) == len(chunk_keys) > 0:
            raise ValueError(f"need a chunk_key per action_key, got {chunk_keys} for {action_keys}")
        execute = chunk_length if execute is None else execute
        prediction_length = chunk_length if prediction_length is None else prediction_length
        check_whole_numbers(chunk_length=chunk_length, execute=execute)
        check_between(0, 1, gamma=gamma)
        if not execute <= chunk_length <= prediction_length:
            lengths = f"{execute}, {chunk_length} and {prediction_length}"
            raise ValueError(f"need execute <= chunk_length <= prediction_length, got {lengths}")
        self.chunk_length, self.execute, self.prediction_length = chunk_length, execute, prediction_length
        self.gamma, self.success, self.by_success = gamma, unravel_key(success), by_success
        check_measures(measures or {})
        self.measures = {key: how for key, how in (measures or {}).items() if how != "last"}
        self._input: TensorDictBase | None = None
        self._inner: tuple[Any, InnerStep, LateTransforms | None, NestedKey] | None = None

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # The wrapped environment's own step executes the first action; _step runs the others.
        inner, chunks = self._inner_step()[0], self._chunks(tensordict)
        # Inverse transforms of the environment below may change it before _step gets it.
        self._input = tensordict.copy()
        rows = tensordict.get("_step", None)
        if rows is not None:
            set_aside(tensordict, inner.observed)
            if not rows.any():  # TorchRL skips the decision, and copies the input
                self._input = None
                tensordict.set(keys.EXECUTED, torch.zeros_like(tensordict.get(keys.EXECUTED)))
        for key, chunk in chunks.items():
            tensordict.set(key, chunk[..., 0, :])
        return tensordict

    def _chunks(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Return the chunks of a decision, by action key."""
        chunks = {}
        for action_key, chunk_key in zip(self.in_keys_inv, self.out_keys_inv, strict=True):
            chunks[action_key] = chunk = tensordict.get(chunk_key)
            if chunk is None or chunk.shape[-2:-1] != (self.prediction_length,):
                raise ValueError(
                    f"ChunkStep expects a chunk [*B, {self.prediction_length}, d_a] at {chunk_key}, found "
                    f"{'nothing' if chunk is None else tuple(chunk.shape)}"
                )
        return chunks

    def _inner_step(self) -> tuple[InnerStep, LateTransforms | None, NestedKey]:
        """Return the step of the wrapped environment, its loop with late transforms, and its reward key."""
        parent = self.parent
        if self._inner is None or self._inner[0] is not parent:
            # TorchRL builds another parent whenever the transforms change.
            inner = InnerStep(self)
            rewards, dones = parent.reward_keys, parent.done_keys
            if len(rewards) != 1 or "done" not in dones:
                raise RuntimeError(
                    "ChunkStep needs one reward and a root 'done', the environment has "
                    f"rewards {rewards} and done keys {dones}"
                )
            kept = dict.fromkeys(parent.state_spec.keys(True, True))
            kept[rewards[0]] = "sum" if self.gamma == 1 else None
            if names := [k for k, how in self.measures.items() if kept.get(unravel_key(k), how) != how]:
                raise ValueError(
                    f"measures of ChunkStep cannot include {names}, a chunk's return or what the next step "
                    "reads: ask for a reward's 'sum' (with gamma=1) and a state's 'last', or have the "
                    "environment write it under another key as well"
                )
            if self.by_success:
                check_keys(parent.observation_spec, [self.success], "ChunkStep(by_success=True)")
            read = (*dones, rewards[0], self.success, *self.measures)
            inner.restarts.check(self.execute)
            parts = [part for transform in inner.transforms for part in flat(transform)]
            below = [f"{type(part).__name__}(" for part in parts]
            for refused, why in _REFUSED.items():
                if any(f"{refused.__name__}(" in text for text in (*below, *_descriptions(inner.base))):
                    raise RuntimeError(f"ChunkStep cannot come after {refused.__name__}, {why}")
            self._check_shapes(inner.base, parent)
            later = dropwhile(lambda part: part is not self, flat(self.container.transform))
            if any(_acts_as(part, FrameSkipTransform) for part in later):
                raise RuntimeError(
                    "FrameSkipTransform after ChunkStep would repeat chunks, of which the history sees one: "
                    "append it before, where it repeats single actions"
                )
            late = LateTransforms.of(inner, read, self.in_keys_inv)
            self._inner = (parent, inner, late, rewards[0])
        return self._inner[1:]

    def _check_shapes(self, base: EnvBase, parent: EnvBase) -> None:
        """Raise RuntimeError unless every row has one end flag and observations of the same shapes."""
        done, batch = parent.full_done_spec["done"].shape, parent.batch_size
        if tuple(done) != (*batch, 1):
            raise RuntimeError(
                f"ChunkStep needs one end per row, 'done' of shape {[*batch, 1]}, but the environment has "
                f"{list(done)}: reduce it"
            )
        uneven = [
            k for k, leaf in base.observation_spec.items(True, True) if -1 in getattr(leaf, "shape", ())
        ]
        if uneven:
            raise RuntimeError(
                f"the shapes of the observations {uneven} differ between rows, and ChunkStep merges rows: "
                "append it to the environments inside the workers"
            )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        step, late, reward_key = self._inner_step()
        batch = next_tensordict.batch_size
        before, self._input = self._input, None
        if before is None:
            raise RuntimeError("ChunkStep._step was called without ChunkStep.inv: use env.step")
        chunks = self._chunks(before)
        next_tensordict = next_tensordict.clone()  # an environment may write its next one into this memory
        # A plain dictionary, because a tensordict would check its entries at every control step.
        current = dict(before.items())
        preset = current.pop("next", None)
        current.pop("_step", None)
        # The environments that go on; None for all of them, the usual case, which needs no masks.
        alive: Tensor | None = tensordict.get("_step", None)
        if alive is not None:
            alive = alive.view(batch)
            next_tensordict = rows_where(alive, next_tensordict, before)
        results = [next_tensordict]
        if alive is None and late is not None:
            (chunk,) = chunks.values()
            results = late(current, next_tensordict, chunk[..., 1 : self.execute, :], reward_key)
            next_tensordict = results[-1]
        ran = [alive] * len(results)  # which rows made each of these steps
        for i in range(len(results), self.execute):
            done = next_tensordict.get("done")
            if done.any():
                running = ~done.view(batch)
                alive = running if alive is None else alive & running
            if alive is not None and not alive.any():
                break
            update_input(current, next_tensordict, reward_key)
            inputs = TensorDict(current, batch_size=batch, device=next_tensordict.device)
            for key, chunk in chunks.items():
                inputs.set(key, chunk[..., i, :])
            result = step(inputs, alive, last=i == self.execute - 1)
            if alive is not None:
                # Rows that a simulator has restarted show its current state: at the end, a fresh reset.
                but = self._shown() if step.restarts.native else ()
                result = rows_where(alive, result, next_tensordict, but)
            next_tensordict = result
            ran.append(alive)
            results.append(result)

        def terms(key: NestedKey) -> list[Tensor]:
            """Return the values of all steps, 0 in the rows that did not make one."""
            pairs = ((result.get(key), rows) for result, rows in zip(results, ran, strict=True))
            return [v if rows is None else torch.where(expand_as_right(rows, v), v, 0) for v, rows in pairs]

        # Combined before they are written, because the result of the last step is written into.
        rewards = terms(reward_key)
        if self.by_success:
            flags = zip(rewards, terms(self.success), strict=True)
            rewards = [flag.view_as(reward).to(reward.dtype) for reward, flag in flags]
        whole = {reward_key: self._return(rewards)}
        flagged = next_tensordict.get(self.success, None) is not None
        for key, how in ({self.success: "max", **self.measures} if flagged else self.measures).items():
            if how == "sum":
                whole.setdefault(key, torch.stack(terms(key)).sum(0))  # a reward's is its return
            else:
                whole[key] = torch.stack([result.get(key) for result in results]).amax(0)
        masks = [rows for rows in ran if rows is not None]
        steps = torch.full(batch, len(ran) - len(masks), dtype=torch.int64, device=next_tensordict.device)
        whole[keys.EXECUTED] = sum(masks, steps).unsqueeze(-1)
        if preset is not None:
            # A policy may preset other keys under "next", which the inner steps do not return.
            next_tensordict.update(preset.exclude(*next_tensordict.keys(True, True)))
        for key, value in whole.items():
            next_tensordict.set(key, value)
        self._remember_ends(next_tensordict, [keys.EXECUTED, self.success, *self.measures])
        return next_tensordict

    def _shown(self) -> set[NestedKey]:
        """Return the keys of observations that describe one moment, and not a chunk."""
        return {*self.parent.observation_spec.keys(True, True)} - {self.success, *self.measures}

    def _return(self, rewards: list[Tensor]) -> Tensor:
        """Return the discounted sum, accumulated in floating point."""
        total = rewards[0]
        if not total.is_floating_point():
            total = total.to(torch.get_default_dtype())
        for i, reward in enumerate(rewards[1:], 1):
            total = torch.add(total, reward, alpha=self.gamma**i)
        return total

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._inner_step()  # raises errors before the first step, and exists before a step is compiled
        shape = (*tensordict_reset.batch_size, 1)
        executed = torch.zeros(shape, dtype=torch.int64, device=tensordict_reset.device)
        for key in self._summed(tensordict_reset):
            value = tensordict_reset.get(key)
            tensordict_reset.set(key, value.to(torch.promote_types(value.dtype, torch.int64)))
        return tensordict_reset.set(keys.EXECUTED, executed)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Replace the action by a chunk of ``P`` actions."""
        actions = input_spec["full_action_spec"]
        present = set(actions.keys(True, True))
        if present != set(self.in_keys_inv):
            raise KeyError(
                f"the environment takes the actions {sorted(map(str, present))}, but ChunkStep has "
                f"action_keys {self.in_keys_inv}: name all actions, with a chunk_key each"
            )
        for action_key, chunk_key in zip(self.in_keys_inv, self.out_keys_inv, strict=True):
            leaf = actions[action_key]
            if leaf.ndim != input_spec.ndim + 1:
                raise ValueError(
                    f"ChunkStep takes actions that are vectors [*B, d_a], but {action_key!r} has shape "
                    f"{tuple(leaf.shape)} for the batch size {tuple(input_spec.shape)}: make a number a "
                    f"vector with UnsqueezeTransform; {GROUP}"
                )
            *batch, width = leaf.shape
            actions[chunk_key] = leaf.unsqueeze(-2).expand(*batch, self.prediction_length, width).clone()
            del actions[action_key]
            if isinstance(action_key, tuple) and actions[action_key[0]].is_empty():
                del actions[action_key[0]]  # an empty branch would count as an action
        return input_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Replace the reward by the discounted sum of up to ``execute`` rewards."""
        for key, leaf in list(reward_spec.items(True, True)):
            dtype = leaf.dtype if leaf.dtype.is_floating_point else torch.get_default_dtype()
            reward_spec[key] = Unbounded(leaf.shape, dtype=dtype, device=leaf.device)
        return reward_spec

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the number of executed steps; sums may leave the bounds, and the type, of their terms."""
        like = {"dtype": torch.int64, "device": observation_spec.device}
        observation_spec[keys.EXECUTED] = Unbounded((*observation_spec.shape, 1), **like)
        for key in self._summed(observation_spec):
            leaf = observation_spec[key]
            like["dtype"] = torch.promote_types(leaf.dtype, torch.int64)
            observation_spec[key] = Unbounded(leaf.shape, **like)
        return observation_spec

    def _summed(self, place: TensorDictBase | TensorSpec) -> list[NestedKey]:
        present = place.keys(True, True)
        return [key for key, how in self.measures.items() if how == "sum" and key in present]
