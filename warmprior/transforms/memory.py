"""What an environment hands from one decision to the next."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.data import Categorical, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from warmprior import keys

__all__ = ["ChunkMemory"]


class ChunkMemory(Transform):
    """Writes a chunk, where it holds and a number of steps for the next decision, and zeros at resets.

    A function of the step's own tensordict, without state of its own: it gives the same in ``env.rollout``,
    collectors and batched environments, inside or outside of workers, with any policy (random ones
    included), and per sub-environment when some of them reset. Subclasses tell what is remembered.

    Args:
        memory_keys: where the chunk (float, ``[*B, P, d_a]``), the mask (bool, ``[*B, P, 1]``) and the
            number (int64, ``[*B, 1]``) are written.

    Keyword Args:
        chunk_key: the predicted chunk, ``[*B, P, d_a]``.
        executed_key: the number of executed actions, int64 ``[*B, 1]``.

    Raises:
        ValueError: (in an environment) if chunks are not as long as what is remembered needs.
        KeyError: if :class:`ChunkStep` does not come before, or a step's input lacks what is remembered.
    """

    def __init__(
        self,
        memory_keys: tuple[NestedKey, NestedKey, NestedKey],
        *,
        chunk_key: NestedKey = keys.CHUNK,
        executed_key: NestedKey = keys.EXECUTED,
    ) -> None:
        super().__init__(in_keys=[chunk_key], out_keys=list(memory_keys))
        self.memory_keys = [unravel_key(key) for key in memory_keys]
        self.chunk_key = unravel_key(chunk_key)
        self.executed_key = unravel_key(executed_key)
        self._chunk: TensorSpec | None = None

    def _check_length(self, length: int) -> None:
        # Raises a ValueError if the environment's chunks are not as long as what is remembered needs.
        raise NotImplementedError

    def _remember(
        self, tensordict: TensorDictBase, executed: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        # The chunk, the mask and the number, of the step's input, which holds those of this decision.
        raise NotImplementedError

    def _check_input(self, tensordict: TensorDictBase) -> None:
        missing = [key for key in self.memory_keys if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"{type(self).__name__} found no {missing} in a step's input: hand over what the reset or "
                "the step before gave, with the chunk"
            )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._check_input(tensordict)
        executed = next_tensordict.get(self.executed_key)
        if executed is None:
            raise KeyError(
                f"{type(self).__name__} found no {self.executed_key!r} after the step: append it after "
                "ChunkStep"
            )
        rows = tensordict.get("_step", None)
        for key, value in zip(self.memory_keys, self._remember(tensordict, executed), strict=True):
            before = tensordict.get(key)
            if value.is_floating_point() and before.is_floating_point():
                value = value.to(before.dtype)  # a policy may compute in another precision
            if rows is not None:
                # A partial step: the others were not asked, and what lies in their chunk was not executed.
                asked = expand_as_right(rows.view(next_tensordict.batch_size), before)
                value = torch.where(asked, value, before)
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Everywhere: TorchRL merges these rows into the sub-environments that were reset only.
        batch, device = tensordict_reset.batch_size, tensordict_reset.device
        chunk = self._chunk or self._check_chunk()
        for key, (width, dtype) in zip(self.memory_keys, _layout(chunk), strict=True):
            tensordict_reset.set(key, torch.zeros(*batch, *width, dtype=dtype, device=device))
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Does nothing: in data the keys are already there."""
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the chunk, the mask and the number."""
        batch, device = observation_spec.shape, observation_spec.device
        for key, (width, dtype) in zip(self.memory_keys, _layout(self._check_chunk()), strict=True):
            shape = (*batch, *width)
            if dtype is torch.bool:
                observation_spec[key] = Categorical(2, shape=shape, dtype=dtype, device=device)
            else:
                observation_spec[key] = Unbounded(shape, dtype=dtype, device=device)
        return observation_spec

    def _check_chunk(self) -> TensorSpec:
        actions = self.parent.full_action_spec
        if self.chunk_key not in actions.keys(True, True):
            raise KeyError(
                f"{type(self).__name__} found no {self.chunk_key} among the actions "
                f"{list(actions.keys(True, True))}: append it after ChunkStep"
            )
        chunk = actions[self.chunk_key]
        self._check_length(chunk.shape[-2])
        # Kept because resets are frequent and TorchRL rebuilds specs on every access.
        self._chunk = chunk
        return chunk


def _layout(chunk: TensorSpec) -> tuple[tuple[tuple[int, ...], torch.dtype], ...]:
    # Shapes behind the batch, and dtypes, in the order of the keys.
    length, action_dim = chunk.shape[-2:]
    return (
        ((length, action_dim), chunk.dtype),
        ((length, 1), torch.bool),
        ((1,), torch.int64),
    )
