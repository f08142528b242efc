"""What transforms behind :class:`ChunkStep` ask of it."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec

__all__ = ["chunk_spec", "executed_steps"]


def chunk_spec(action_spec: TensorSpec, chunk_key: NestedKey, asking: str) -> TensorSpec:
    """The spec of the chunk among the actions of an environment.

    Args:
        action_spec: all actions.
        chunk_key: the chunk.
        asking: the transform, for the error.

    Raises:
        KeyError: if there is no chunk.
    """
    if chunk_key not in action_spec.keys(True, True):
        raise KeyError(
            f"{asking} found no {chunk_key} among the actions "
            f"{list(action_spec.keys(True, True))}: append it after ChunkStep"
        )
    return action_spec[chunk_key]


def executed_steps(next_tensordict: TensorDictBase, executed_key: NestedKey, asking: str) -> Tensor:
    """The number of actions that a decision executed, int64 ``[*B, 1]``.

    Args:
        next_tensordict: what the step gave.
        executed_key: where it is told.
        asking: the transform, for the error.

    Raises:
        KeyError: if it is not told.
    """
    executed = next_tensordict.get(executed_key)
    if executed is None:
        raise KeyError(
            f"{asking} found no {executed_key!r} after the step: append it after ChunkStep"
        )
    return executed
