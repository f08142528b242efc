"""Execution of action chunks in an environment, exact at every episode end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import VecGymEnvTransform

from warmprior import keys
from warmprior.transforms.inner_step import EnvTransform, InnerStep, rows_where, set_aside
from warmprior.transforms.late import LateTransforms, advance

__all__ = ["ChunkStep"]


class ChunkStep(EnvTransform):
    r"""Turns an environment of single actions into one of action chunks (a semi-MDP).

    One outer step executes the first ``execute`` actions of a chunk ``[*B, P, d_a]``, and stops each
    sub-environment at the end of its own episode. The reward is the discounted sum :math:`\sum_{i<k} \gamma^i
    r_i` over the ``k`` executed steps, written to ``("next", "executed_steps")``; everything but ``success``
    and ``measures`` is taken from the last of them. Unlike :class:`~torchrl.envs.transforms.MultiAction` it
    keeps the last reward of an episode that ends inside a chunk, and works inside and outside batched
    environments.

    Per-step transforms (``StepCounter``, ``RewardSum``, ``ActionScaling``, ``CatFrames``, ``VideoRecorder``)
    go before it, per-decision ones (:class:`ActionHistory`, ``InitTracker``) after. If none of the former
    remembers anything (``ObservationNorm``, ``ActionScaling``, :class:`ObservationStack`), they run only at
    the steps that a chunk's last observation depends on. In a partial step, resting rows keep all
    observations.

    .. note::
        Around a batched environment, TorchRL's transforms with memory, such as ``CatFrames`` or
        ``VecNormV2``, update it in all rows, also in those that a partial step leaves out. If rows rest for
        longer than until their reset, place such transforms inside the workers. :class:`ObservationStack` has
        no such memory.

    Args:
        chunk_length: ``H``.
        execute: ``k``, how many actions of a chunk are executed before the next decision; ``H`` by default.
        prediction_length: ``P``, the length of the chunks that the policy gives; ``H`` by default.
        gamma: discount per control step.
        success: a bool flag that holds after a chunk if it held after any of its executed steps; ignored if
            the environment does not write it.
        measures: further keys whose values after a chunk are the ``"max"``, ``"sum"`` or ``"last"`` of those
            after its executed steps.

    Raises:
        ValueError: if not ``1 <= execute <= chunk_length <= prediction_length``, or an action is not one
            vector.
        KeyError: (in an environment) if there is no such action.
        RuntimeError: (on the first step) if the environment has several rewards or no root ``"done"``, or is
            a vector environment of Gymnasium.

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
        measures: Mapping[str, Literal["max", "sum", "last"]] | None = None,
    ) -> None:
        super().__init__(in_keys_inv=[keys.ACTION], out_keys_inv=[keys.CHUNK])
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
        self.success = unravel_key(success)
        self.measures = {key: how for key, how in (measures or {}).items() if how != "last"}
        self._input: TensorDictBase | None = None
        self._inner: tuple[Any, InnerStep, LateTransforms | None, NestedKey] | None = None

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # The wrapped environment's own step executes the first action; _step runs the others.
        chunk = tensordict.get(keys.CHUNK)
        if chunk is None or chunk.shape[-2] != self.prediction_length:
            found = "nothing" if chunk is None else f"shape {tuple(chunk.shape)}"
            raise ValueError(
                f"ChunkStep expects a chunk [*B, {self.prediction_length}, d_a] at "
                f"{keys.CHUNK}, found {found}"
            )
        # Inverse transforms of the environment below may change it before _step gets it.
        self._input = tensordict.copy()
        if "_step" in tensordict:
            set_aside(tensordict, self._inner_step()[0].observed)
        return tensordict.set(keys.ACTION, chunk[..., 0, :])

    def _inner_step(self) -> tuple[InnerStep, LateTransforms | None, NestedKey]:
        """How to step what this transform wraps, also with late transforms, and the key of its reward."""
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
            if rewards[0] in self.measures:
                raise ValueError(
                    f"measures of ChunkStep cannot be the reward {rewards[0]!r}, which after a chunk is its "
                    "return: have the environment write it under another key as well"
                )
            read = (*dones, rewards[0], self.success, *self.measures)
            if self.execute > 1 and any(isinstance(t, VecGymEnvTransform) for t in inner.transforms):
                raise RuntimeError(
                    "ChunkStep cannot step a vector environment of Gymnasium (num_envs): it restarts an "
                    "episode that ends inside a chunk, and the rest of the chunk would be played in the next "
                    "one. Use SerialEnv or ParallelEnv of single environments"
                )
            late = LateTransforms.of(inner, read)
            self._inner = (parent, inner, late, rewards[0])
        return self._inner[1:]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        step, late, reward_key = self._inner_step()
        batch = next_tensordict.batch_size
        before, self._input = self._input, None
        if before is None:
            raise RuntimeError("ChunkStep._step was called without ChunkStep.inv: use env.step")
        chunk = before.get(keys.CHUNK)[..., : self.execute, :]
        # A plain dictionary: a tensordict's checks would be made at every control step.
        current = dict(before.items())
        preset = current.pop("next", None)
        current.pop("_step", None)
        # Which environments go on; None for all of them, the usual case, which needs no masks.
        alive: Tensor | None = tensordict.get("_step", None)
        if alive is not None:
            alive = alive.view(batch)
            next_tensordict = rows_where(alive, next_tensordict, before)
        results = [next_tensordict]
        if alive is None and late is not None:
            results = late(current, next_tensordict, chunk[..., 1:, :], reward_key)
            next_tensordict = results[-1]
        earned = [result.get(reward_key) for result in results]
        ran = [alive] * len(results)  # which rows made each of these steps
        steps = torch.full(batch, len(results), dtype=torch.int64, device=chunk.device)
        steps = steps if alive is None else alive.long()
        for i in range(len(results), self.execute):
            done = next_tensordict.get("done")
            if done.any():
                running = ~done.view(batch)
                alive = running if alive is None else alive & running
            if alive is not None and not alive.any():
                break
            advance(current, next_tensordict, reward_key)
            inputs = TensorDict(current, batch_size=batch, device=next_tensordict.device)
            result = step(inputs.set(keys.ACTION, chunk[..., i, :]), alive)
            reward = result.get(reward_key)
            if alive is None:
                next_tensordict = result
                steps += 1
            else:
                reward = torch.where(expand_as_right(alive, reward), reward, 0)
                next_tensordict = rows_where(alive, result, next_tensordict)
                steps += alive
            earned.append(reward)
            ran.append(alive)
            results.append(next_tensordict)
        if preset is not None:
            # A policy may preset other keys under "next", which the inner steps do not return.
            next_tensordict.update(preset.exclude(*next_tensordict.keys(True, True)))
        if next_tensordict.get(self.success, None) is not None:
            flags = torch.stack([result.get(self.success) for result in results])
            next_tensordict.set(self.success, flags.any(0))
        for key, how in self.measures.items():
            values = [result.get(key) for result in results]
            if how == "max":
                next_tensordict.set(key, torch.stack(values).amax(0))
                continue
            counted = [
                value if rows is None else torch.where(expand_as_right(rows, value), value, 0)
                for rows, value in zip(ran, values, strict=True)
            ]
            next_tensordict.set(key, torch.stack(counted).sum(0))
        next_tensordict.set(reward_key, self._return(earned))
        return next_tensordict.set(keys.EXECUTED, steps.unsqueeze(-1))

    def _return(self, rewards: list[Tensor]) -> Tensor:
        """The discounted sum, accumulated in floating point."""
        total = rewards[0]
        if not total.is_floating_point():
            total = total.to(torch.get_default_dtype())
        for i, reward in enumerate(rewards[1:], 1):
            total = torch.add(total, reward, alpha=self.gamma**i)
        return total

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        shape = (*tensordict_reset.batch_size, 1)
        executed = torch.zeros(shape, dtype=torch.int64, device=tensordict_reset.device)
        return tensordict_reset.set(keys.EXECUTED, executed)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Replace the action by a chunk of ``P`` actions."""
        actions, ndim = input_spec["full_action_spec"], input_spec.ndim
        if keys.ACTION not in actions.keys(True, True):
            raise KeyError(
                f"ChunkStep found no {keys.ACTION!r}, only {list(actions.keys(True, True))}: rename it with "
                "TorchRL's RenameTransform"
            )
        leaf = actions[keys.ACTION]
        if leaf.ndim != ndim + 1:
            raise ValueError(
                "ChunkStep takes environments whose action is one vector [*B, d_a], but "
                f"{keys.ACTION!r} has shape {tuple(leaf.shape)} for the batch size "
                f"{tuple(input_spec.shape)}: make it a vector before, for instance with FlattenAction or "
                "UnsqueezeTransform"
            )
        leaf = leaf.unsqueeze(ndim)
        leaf = leaf.expand(*leaf.shape[:ndim], self.prediction_length, *leaf.shape[ndim + 1 :])
        actions[keys.CHUNK] = leaf.clone()
        del actions[keys.ACTION]
        return input_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """The discounted sum of up to ``execute`` rewards."""
        for key, leaf in list(reward_spec.items(True, True)):
            dtype = leaf.dtype if leaf.dtype.is_floating_point else torch.get_default_dtype()
            reward_spec[key] = Unbounded(leaf.shape, dtype=dtype, device=leaf.device)
        return reward_spec

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the number of executed steps."""
        observation_spec[keys.EXECUTED] = Unbounded(
            (*observation_spec.shape, 1), dtype=torch.int64, device=observation_spec.device
        )
        return observation_spec
