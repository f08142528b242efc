"""A stack of the last observations, without state."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.data import Composite

from warmprior import keys
from warmprior.checks import check_keys, check_whole_numbers
from warmprior.transforms.inner_step import GROUP, EnvTransform, observed, set_aside


class ObservationStack(EnvTransform):
    """A transform that replaces the observation ``[*B, d_o]`` by the last ``To``, ``[*B, To, d_o]``.

    Images ``[*B, C, H, W]`` become ``[*B, To, C, H, W]``; every entry of a nested observation is stacked.
    After a reset the first observation is repeated. Unlike :class:`~torchrl.envs.transforms.CatFrames` it
    keeps no buffer: older observations come from the step's own tensordict. So it is correct inside and
    outside batched environments, and when only some sub-environments reset or step.

    Args:
        steps: ``To``.
        observation_key: key of the observation, in and out, or of entries nested under it.

    Raises:
        ValueError: if ``steps < 1``, or the environment reads the observation as its state.
        KeyError: if the environment has no such observation, or (on a step) the input has no stack yet.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import ObservationStack
        >>> rollout = TransformedEnv(GymEnv("Pendulum-v1"), ObservationStack(2)).rollout(3)
        >>> rollout["observation"].shape
        torch.Size([3, 2, 3])
        >>> bool((rollout["observation"][1:, 0] == rollout["observation"][:-1, 1]).all())
        True
    """

    def __init__(self, steps: int, *, observation_key: NestedKey = keys.OBSERVATION) -> None:
        super().__init__(in_keys=[observation_key], out_keys=[observation_key])
        check_whole_numbers(steps=steps)
        self.steps = steps
        self.observation_key = unravel_key(observation_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        set_aside(tensordict, {self.observation_key: None})
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        time = next_tensordict.ndim
        newest = next_tensordict.get(self.observation_key)
        rows = tensordict.get("_step", None)
        if self.steps == 1 and rows is None:
            stack = _each(lambda new: new.unsqueeze(time), newest)
            return next_tensordict.set(self.observation_key, stack)

        def append(new: Tensor, old: Tensor) -> Tensor:
            recent = old.narrow(time, 1, self.steps - 1)
            stack = torch.cat([recent, new.unsqueeze(time)], dim=time)
            if rows is None:
                return stack
            return torch.where(expand_as_right(rows.view(next_tensordict.shape), old), stack, old)

        before = observed(tensordict, self.observation_key, "ObservationStack")
        return next_tensordict.set(self.observation_key, _each(append, newest, before))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._check_key(tensordict_reset)
        time = tensordict_reset.ndim
        # Rows that were not reset keep their stack, because TorchRL merges only the others.
        stack = _each(
            lambda first: torch.stack([first] * self.steps, dim=time),
            tensordict_reset.get(self.observation_key),
        )
        return tensordict_reset.set(self.observation_key, stack)

    def _as_reset(self, stepped: TensorDictBase) -> TensorDictBase:
        # The step has appended the new episode's first observation to the stack of the old one.
        time = stepped.ndim
        newest = _each(lambda stack: stack.select(time, -1), stepped.get(self.observation_key))
        return stepped.set(self.observation_key, newest)

    def _check_key(self, observations: TensorDictBase | Composite) -> None:
        hint = f"; there are {list(observations.keys(True, True))}: name one with observation_key"
        check_keys(observations, [self.observation_key], "ObservationStack", hint)
        *branch, _ = key if isinstance(key := self.observation_key, tuple) else (key,)
        shape = observations[tuple(branch)].shape if branch else observations.shape
        if shape != observations.shape:
            raise ValueError(
                f"ObservationStack found {key!r} in a branch of shape {list(shape)}, in an environment of "
                f"batch size {list(observations.shape)}: {GROUP}"
            )

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Refuse to replace what the environment reads as its state."""
        if self.observation_key in input_spec["full_state_spec"].keys(True):
            raise ValueError(
                f"ObservationStack would replace the environment's own state {self.observation_key!r}: make "
                "a copy before (RenameTransform with create_copy=True), and name it with observation_key"
            )
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Insert the stack's dimension after those of the batch."""
        self._check_key(observation_spec)
        time = observation_spec.ndim
        spec = observation_spec[self.observation_key]
        leaves = spec.items(True, True) if isinstance(spec, Composite) else [((), spec)]
        for key, leaf in list(leaves):
            if leaf.ndim == time:
                raise ValueError(
                    f"ObservationStack takes vectors or images, but {key or self.observation_key!r} is a "
                    "number or text per row: make it a vector before, for instance with UnsqueezeTransform, "
                    "or keep text beside the observation"
                )
            shape = (*leaf.shape[:time], self.steps, *leaf.shape[time:])
            stack = leaf.unsqueeze(time).expand(shape).clone()
            observation_spec[unravel_key((self.observation_key, key))] = stack
        return observation_spec


def _each(
    function: Callable[..., Tensor], value: Tensor | TensorDictBase, *others: Tensor | TensorDictBase
) -> Tensor | TensorDictBase:
    """Apply a function to an observation, or to each of its entries."""
    if isinstance(value, TensorDictBase):
        return value.apply(function, *others)
    return function(value, *others)
