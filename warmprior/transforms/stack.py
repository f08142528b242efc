"""The last observations, stacked without state."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from warmprior import keys
from warmprior.transforms.inner_step import KEPT, set_aside

__all__ = ["ObservationStack"]


class ObservationStack(Transform):
    """Replaces the observation ``[*B, d_o]`` by the last ``To`` of them, ``[*B, To, d_o]``.

    After a reset the first observation is repeated. Unlike
    :class:`~torchrl.envs.transforms.CatFrames` it keeps no buffer: the older observations are taken
    from the step's own tensordict, so that it is right wherever a tensordict is, in and outside of
    batched environments and when only some sub-environments reset or step.

    Args:
        steps: ``To``.

    Keyword Args:
        observation_key: key of the observation, in and out.

    Raises:
        ValueError: if ``steps < 1``.
        KeyError: (on a step) if the tensordict does not hold the current stack.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), ObservationStack(2))
        >>> rollout = env.rollout(3)
        >>> rollout["observation"].shape
        torch.Size([3, 2, 3])
        >>> bool((rollout["observation"][1:, 0] == rollout["observation"][:-1, 1]).all())
        True
    """

    def __init__(self, steps: int, *, observation_key: NestedKey = keys.OBSERVATION) -> None:
        super().__init__(in_keys=[observation_key], out_keys=[observation_key])
        if steps < 1:
            raise ValueError(f"an observation stack needs at least 1 step, got {steps}")
        self.steps = steps
        self.observation_key = unravel_key(observation_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if "_step" in tensordict:
            set_aside(tensordict, [self.observation_key])
        return tensordict

    def _stack(self, tensordict: TensorDictBase) -> Tensor:
        for place in (tensordict, tensordict.get(KEPT, None)):
            stack = None if place is None else place.get(self.observation_key, None)
            if stack is not None:
                return stack
        raise KeyError(
            f"ObservationStack needs the current {self.observation_key!r} to append to: step with "
            "what reset or step_mdp returned"
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        newest = next_tensordict.get(self.observation_key).unsqueeze(-2)
        asked = tensordict.get("_step", None)
        if self.steps > 1 or asked is not None:
            stack = self._stack(tensordict)
            newest = torch.cat([stack[..., 1:, :], newest], dim=-2)
            if asked is not None:
                newest = torch.where(
                    expand_as_right(asked.view(stack.shape[:-2]), stack), newest, stack
                )
        return next_tensordict.set(self.observation_key, newest)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        first = tensordict_reset.get(self.observation_key).unsqueeze(-2)
        # Rows that were not reset keep their stack: TorchRL merges only the others.
        stack = first.expand(*first.shape[:-2], self.steps, first.shape[-1]).clone()
        return tensordict_reset.set(self.observation_key, stack)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Outside environments the transform does nothing: windows are stacked already."""
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Insert the stack's dimension before the last one."""
        leaf = observation_spec[self.observation_key].unsqueeze(-2)
        shape = (*leaf.shape[:-2], self.steps, leaf.shape[-1])
        observation_spec[self.observation_key] = leaf.expand(shape).clone()
        return observation_spec
