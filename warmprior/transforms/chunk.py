"""Execution of action chunks in an environment, exact at every episode end."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform, TransformedEnv

from warmprior import keys

__all__ = ["ChunkStep"]


class ChunkStep(Transform):
    r"""Turns an environment of single actions into one of action chunks (a semi-MDP).

    One outer step executes the first ``execute`` actions of a chunk ``[*B, P, d_a]``, stopping each
    sub-environment at its own episode end. The reward is the discounted sum
    :math:`\sum_{i<k} \gamma^i r_i` over the ``k`` executed steps, ``k`` itself is written to
    ``("next", "executed_steps")``, and everything else is that of the last executed step. Unlike
    :class:`~torchrl.envs.transforms.MultiAction` it keeps the last reward of an episode that ends
    inside a chunk and has fixed shapes, so that it works inside and outside batched environments.

    Per-step transforms (``StepCounter``, ``RewardSum``, ``ActionScaling``, ``CatFrames``,
    ``VideoRecorder``) go before it, per-decision ones (:class:`ActionHistory`, ``InitTracker``) after.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        execute: ``k``, how many actions of a chunk are executed before the next decision; ``H`` by
            default.
        prediction_length: ``P``, the length of the chunks that the policy gives; ``H`` by default.
        gamma: discount per control step.
        action_key: the single action that the wrapped environment takes.
        chunk_key: the chunk, ``[*B, P, d_a]``.
        executed_key: where ``k`` is written, int64 ``[*B, 1]``.

    Raises:
        ValueError: if not ``1 <= execute <= chunk_length <= prediction_length``.
        RuntimeError: (on the first step) if the environment has several rewards, done flags or
            resets itself.

    Examples:
        >>> import torch
        >>> from torchrl.envs import GymEnv, StepCounter, TransformedEnv, Compose
        >>> env = TransformedEnv(
        ...     GymEnv("Pendulum-v1"), Compose(StepCounter(max_steps=10), ChunkStep(4)))
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
        action_key: NestedKey = keys.ACTION,
        chunk_key: NestedKey = keys.CHUNK,
        executed_key: NestedKey = keys.EXECUTED,
    ) -> None:
        super().__init__(in_keys_inv=[action_key], out_keys_inv=[chunk_key])
        execute = chunk_length if execute is None else execute
        prediction_length = chunk_length if prediction_length is None else prediction_length
        if not 1 <= execute <= chunk_length <= prediction_length:
            raise ValueError(
                "need 1 <= execute <= chunk_length <= prediction_length, got "
                f"execute={execute}, chunk_length={chunk_length}, "
                f"prediction_length={prediction_length}"
            )
        self.chunk_length = chunk_length
        self.execute = execute
        self.prediction_length = prediction_length
        self.gamma = gamma
        self.action_key = unravel_key(action_key)
        self.chunk_key = unravel_key(chunk_key)
        self.executed_key = unravel_key(executed_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # The wrapped environment's own step executes the first action; _step runs the others.
        chunk = tensordict.get(self.chunk_key)
        if chunk is None or chunk.shape[-2] != self.prediction_length:
            found = "nothing" if chunk is None else f"shape {tuple(chunk.shape)}"
            raise ValueError(
                f"ChunkStep expects a chunk [*B, {self.prediction_length}, d_a] at "
                f"{self.chunk_key}, found {found}"
            )
        return tensordict.set(self.action_key, chunk[..., 0, :])

    def _keys_of_parent(self) -> tuple[Any, NestedKey, NestedKey]:
        parent = self.parent
        if parent is None:
            raise RuntimeError("ChunkStep only steps environments: append it to a TransformedEnv")
        if len(parent.reward_keys) != 1 or unravel_key("done") not in parent.done_keys:
            raise RuntimeError(
                "ChunkStep needs one reward and a root 'done', the environment has "
                f"rewards {parent.reward_keys} and done keys {parent.done_keys}"
            )
        return parent, parent.reward_keys[0], "done"

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        parent, reward_key, done_key = self._keys_of_parent()
        chunk = tensordict.get(self.chunk_key)
        reward: Tensor = next_tensordict.get(reward_key)
        done: Tensor = next_tensordict.get(done_key)
        asked = tensordict.get("_step", None)
        # Which environments go on; None for all of them, the usual case, which needs no masks.
        alive = None if asked is None else asked.view(done.shape)
        steps = torch.ones_like(done, dtype=torch.int64) if alive is None else alive.long()
        discount = self.gamma
        current = tensordict.copy()
        for i in range(1, self.execute):
            if done.any():
                alive = ~done if alive is None else alive & ~done
            if alive is not None and not alive.any():
                break
            _advance(current, next_tensordict, reward_key)
            current.set(self.action_key, chunk[..., i, :])
            if alive is None:
                # What EnvBase.step adds to TransformedEnv._step are checks: the outer step makes them.
                next_tensordict = (
                    parent._step(current)
                    if isinstance(parent, TransformedEnv)
                    else parent.step(current.copy()).get("next")
                )
                reward = torch.add(reward, next_tensordict.get(reward_key), alpha=discount)
                steps += 1
            else:
                # A partial step: batched environments leave the finished ones alone.
                current.set("_step", alive.view(current.shape))
                out = parent.step(current.copy()).get("next")
                reward = reward + torch.where(alive, out.get(reward_key), 0.0) * discount
                steps += alive
                next_tensordict = _update_where(alive, next_tensordict, out)
            discount *= self.gamma
            done = next_tensordict.get(done_key)
        next_tensordict.set(reward_key, reward)
        return next_tensordict.set(self.executed_key, steps)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape = (*tensordict_reset.batch_size, 1)
        executed = torch.zeros(shape, dtype=torch.int64, device=tensordict_reset.device)
        return tensordict_reset.set(self.executed_key, executed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Outside environments the transform does nothing."""
        return tensordict

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Replace the action by a chunk of ``P`` actions."""
        leaf = input_spec["full_action_spec", self.action_key]
        ndim = input_spec.ndim
        leaf = leaf.unsqueeze(ndim)
        leaf = leaf.expand(*leaf.shape[:ndim], self.prediction_length, *leaf.shape[ndim + 1 :])
        actions = input_spec["full_action_spec"]
        actions[self.chunk_key] = leaf.clone()
        del actions[self.action_key]
        return input_spec

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the number of executed steps."""
        observation_spec[self.executed_key] = Unbounded(
            (*observation_spec.shape, 1), dtype=torch.int64, device=observation_spec.device
        )
        return observation_spec


def _advance(
    current: TensorDictBase, next_tensordict: TensorDictBase, reward_key: NestedKey
) -> None:
    """As ``step_mdp``, in place and without its generality: it runs at every control step."""
    for key, value in next_tensordict.items():
        if key == reward_key:
            continue
        mine = current.get(key, None) if is_tensor_collection(value) else None
        if mine is None:
            current.set(key, value)
        else:
            mine.update(value)


def _update_where(mask: Tensor, old: TensorDictBase, new: TensorDictBase) -> TensorDictBase:
    """``old`` with the rows of ``new`` where ``mask`` holds, for the keys that the step produced.

    A policy may have preset other keys under "next"; the inner steps do not return those.
    """
    result = old.copy()
    mask = mask.view(old.shape)
    for key in new.keys(True, True):
        previous = old.get(key, None)
        value = new.get(key)
        if previous is not None:
            value = torch.where(expand_as_right(mask, value), value, previous)
        result.set(key, value)
    return result
