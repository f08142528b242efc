"""Execution of chunks that take effect late, because computing them takes time."""

from __future__ import annotations

from numbers import Integral

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from warmprior import keys
from warmprior.modules.real_time_chunking import with_leftover
from warmprior.transforms.memory import ChunkMemory

__all__ = ["InferenceDelay", "check_delay", "executed_chunk", "shift_chunk"]


def check_delay(delay: int, execute: int, length: int | None = None) -> None:
    """Whether chunks can take effect so late.

    Args:
        delay: ``d``, control steps until a chunk takes effect.
        execute: actions executed per decision.
        length: ``P``, how many a chunk has, if it is known.

    Raises:
        ValueError: if ``delay`` is no whole number, not ``0 <= delay <= execute``, or ``execute + delay``
            exceeds ``length``.
    """
    if isinstance(delay, bool) or not isinstance(delay, Integral) or delay < 0:
        raise ValueError(f"a delay is a whole number of control steps, at least 0, got {delay!r}")
    if length is not None and 2 * delay > length:
        raise ValueError(
            f"a delay of {delay} control steps is too long for predictions of {length} actions, of which "
            f"as many are executed, and as many more until the next ones take effect: at most {length // 2}. "
            "Predict longer chunks, or make the policy faster"
        )
    if delay > execute:
        raise ValueError(
            f"a delay of {delay} control steps does not go with {execute} actions per decision: need "
            "0 <= delay <= execute, or the next decision is due before the last one took effect"
        )
    if length is not None and execute + delay > length:
        raise ValueError(
            f"predictions of {length} actions do not reach {execute} executed ones and a delay of {delay} "
            f"more: execute at most {length - delay} per decision, or predict longer chunks"
        )


def executed_chunk(tensordict: TensorDictBase, chunk_key: NestedKey = keys.CHUNK) -> Tensor:
    """The chunks of decisions as they are executed: of late ones, first the rest of the one before.

    Args:
        tensordict: ``[*B]`` decisions, such as those of a rollout.
        chunk_key: the prediction, ``[*B, P, d_a]``; without a delay beside it, it is executed as it is.

    See Also:
        - :class:`~warmprior.InferenceDelay`: lets chunks take effect late.
        - :func:`~warmprior.diagnostics.executed_actions`: the actions of a whole rollout.

    Examples:
        >>> from tensordict import TensorDict
        >>> chunk, leftover = torch.ones(1, 3, 1), torch.zeros(1, 3, 1)
        >>> data = TensorDict({keys.CHUNK: chunk, keys.LEFTOVER: leftover}, [1])
        >>> executed_chunk(data.set(keys.DELAY, torch.tensor([[1]]))).flatten().tolist()
        [0.0, 1.0, 1.0]
    """
    delay = tensordict.get(keys.DELAY, None)
    if delay is None:
        return tensordict.get(chunk_key)
    return with_leftover(tensordict.get(chunk_key), tensordict.get(keys.LEFTOVER), delay)


def shift_chunk(chunk: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
    """What is left of a chunk, at the positions of the next one.

    Args:
        chunk: ``[*B, P, d_a]``.
        steps: control steps between the two, int64 ``[*B, 1]``.

    Returns:
        The chunk's ``[steps, P)`` followed by zeros, ``[*B, P, d_a]``, and where it holds, bool
        ``[*B, P, 1]``.

    See Also:
        :func:`~warmprior.modules.with_leftover`: puts what is left before the next chunk.

    Examples:
        >>> import torch
        >>> left, valid = shift_chunk(torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([2]))
        >>> left.flatten().tolist(), valid.flatten().tolist()
        ([3.0, 0.0, 0.0], [True, False, False])
    """
    length = chunk.shape[-2]
    index = (steps + torch.arange(length, device=chunk.device)).unsqueeze(-1)
    valid = index < length
    index = index.clamp(max=length - 1).expand_as(chunk)
    return torch.where(valid, chunk.gather(-2, index), 0.0), valid


class InferenceDelay(ChunkMemory):
    r"""Lets every chunk take effect ``delay`` control steps after the observation that it answers.

    Simulators wait for policies and robots do not. Here the robot goes on meanwhile: of the ``execute``
    actions of a decision the first ``delay`` ones are those that the chunk before holds for these control
    steps, and the new chunk's positions from ``delay`` on follow. At the first decision of an episode there
    is no chunk to go on with, and the robot waits. With ``delay=0`` it only tells what is left of the chunk.

    It is a function of the step's own tensordict, without state, as :class:`ActionHistory` is. Append it
    after that one, which then remembers what was executed, and forecasts from it: WP-Past's mean is
    the last ``H`` executed actions, WP-Preview's the forecast of the same control steps. The policy decides
    every ``execute`` steps, so that predictions have to reach ``execute + delay`` steps: with ``H = P``
    (Gaussian source, WP-Past) fewer actions are executed per decision.

    =======================  =======================  =================================================
    key                      shape                    meaning
    =======================  =======================  =================================================
    ``("rtc", "leftover")``  ``[*B, P, d_a]`` float   what the chunk before holds for the next ``P``
                                                      control steps, 0 behind its end
    ``("rtc", "valid")``     ``[*B, P, 1]`` bool      where it holds any
    ``("rtc", "delay")``     ``[*B, 1]`` int64        ``delay``; 0 at the first decision of an episode
    =======================  =======================  =================================================

    :class:`~warmprior.RealTimeChunking` reads them, and :func:`executed_chunk` tells of a rollout what was
    executed.

    Args:
        delay: ``d``, control steps until a chunk takes effect.

    Keyword Args:
        execute: actions executed per decision, as :class:`ChunkStep` has it.
        chunk_key: the chunk, ``[*B, P, d_a]``.
        executed_key: the number of executed actions, int64 ``[*B, 1]``.

    Raises:
        ValueError: if not ``0 <= delay <= execute`` (the next decision would be due before the last one took
            effect), or (in an environment) ``execute + delay`` exceeds the length of predictions.
        KeyError: if :class:`ChunkStep` does not come before, or a step's input lacks what is left.
        RuntimeError: (on a step) if a decision executed more than ``execute`` actions.

    Examples:
        >>> import torch
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import GaussianPrior, policy_transforms
        >>> env = TransformedEnv(
        ...     GymEnv("Pendulum-v1"), policy_transforms(GaussianPrior(4), execute=3, delay=1))
        >>> rollout = env.rollout(3)
        >>> rollout["rtc", "delay"].flatten().tolist()  # the robot waits for the first chunk
        [0, 1, 1]
        >>> chunk, executed = rollout["vla_action", "chunk"], executed_chunk(rollout)
        >>> bool(executed[1, 0] == chunk[0, 3]), bool((executed[1, 1:] == chunk[1, 1:]).all())
        (True, True)
    """

    def __init__(
        self,
        delay: int,
        *,
        execute: int,
        chunk_key: NestedKey = keys.CHUNK,
        executed_key: NestedKey = keys.EXECUTED,
    ) -> None:
        super().__init__(
            (keys.LEFTOVER, keys.VALID, keys.DELAY), chunk_key=chunk_key, executed_key=executed_key
        )
        check_delay(delay, execute)
        self.delay = delay
        self.execute = execute

    def _check_length(self, length: int) -> None:
        check_delay(self.delay, self.execute, length)

    def _remember(
        self, tensordict: TensorDictBase, executed: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        if (executed > self.execute).any():
            raise RuntimeError(
                f"a decision executed {int(executed.max())} actions, and InferenceDelay was told "
                f"execute={self.execute}: give it the number that ChunkStep has"
            )
        # The chunk here is the executed one: TorchRL hands over the input that the inverses gave.
        leftover, valid = shift_chunk(tensordict.get(self.chunk_key), executed)
        return leftover, valid, torch.full_like(executed, self.delay)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_input(tensordict)
        if tensordict.get(self.chunk_key, None) is None:
            return tensordict  # ChunkStep tells
        return tensordict.set(self.chunk_key, executed_chunk(tensordict, self.chunk_key))
