"""Execution of chunks that take effect late because computing them takes time."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from warmprior import keys
from warmprior.checks import check_keys, check_whole_numbers
from warmprior.modules.prior import Prior
from warmprior.modules.real_time_chunking import spliced
from warmprior.transforms.inner_step import EnvTransform, check_unwritten, keep_resting


def check_delay(delay: int, execute: int, length: int | None = None) -> None:
    """Raise ValueError if chunks of ``length`` cannot take effect ``delay`` control steps late."""
    check_whole_numbers(0, delay=delay)
    if length is not None and 2 * delay > length:
        raise ValueError(
            f"a delay of {delay} control steps is too long for predictions of {length} actions: at most "
            f"{length // 2}. Predict longer chunks, make the policy faster, or lower the control rate"
        )
    if delay > execute:
        raise ValueError(
            f"a delay of {delay} control steps needs at least {delay} actions per decision, got {execute}: "
            "the next decision would be due before the last one takes effect"
        )
    if length is not None and execute + delay > length:
        raise ValueError(
            f"predictions of {length} actions do not cover {execute} executed ones and a delay of {delay}: "
            f"execute at most {length - delay} per decision, or predict longer chunks"
        )


def usual_execute(policy: object, prior: Prior, delay: int) -> int:
    """Return the number of actions per decision: the policy's ``execute`` or ``H``, as the delay allows."""
    own = max(getattr(policy, "execute", prior.chunk_length), delay)
    return min(own, prior.chunk_length, prior.prediction_length - delay)


def executed_chunk(
    tensordict: TensorDictBase, chunk_key: NestedKey = keys.CHUNK, history_key: NestedKey = keys.HISTORY
) -> Tensor:
    """Return the chunks of decisions ``[*B]`` as they are executed.

    A late chunk begins with the forecast of the one before; without a recorded delay, chunks do not change.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import keys
        >>> from warmprior.transforms import executed_chunk
        >>> chunk, forecast = torch.ones(1, 3, 1), torch.zeros(1, 3, 1)
        >>> data = TensorDict({keys.CHUNK: chunk, keys.FORECAST: forecast}, [1])
        >>> executed_chunk(data.set(keys.DELAY, torch.tensor([[1]]))).flatten().tolist()
        [0.0, 1.0, 1.0]
    """
    delay = tensordict.get(keys.DELAY, None)
    if delay is None:
        return tensordict.get(chunk_key)
    forecast = tensordict.get(unravel_key((history_key, "forecast")))
    return spliced(tensordict.get(chunk_key), forecast, delay)


class InferenceDelay(EnvTransform):
    """A transform that delays every chunk: it takes effect ``delay`` control steps after its observation.

    Simulators wait for policies; robots do not. Here the robot goes on during the computation: the first
    ``delay`` of the ``execute`` actions come from the previous chunk, the rest from the new one. At the first
    decision of an episode the robot waits. The policy decides every ``execute`` steps, so predictions must
    cover ``execute + delay``: with ``H = P`` (Gaussian source, WP-Past) fewer actions are executed per
    decision.

    It has no state. Append it after :class:`ActionHistory`, which then remembers the executed actions. It
    writes ``("rtc", "delay")``, int64 ``[*B, 1]``, which :class:`~warmprior.RealTimeChunking` reads:
    ``delay``, or 0 at the first decision of an episode. :func:`executed_chunk` returns the executed chunks of
    a rollout.

    Args:
        delay: ``d``, control steps until a chunk takes effect.
        execute: actions executed per decision, the same as in :class:`ChunkStep`.
        chunk_key: key of the chunk.
        history_key: key of the history.

    Raises:
        ValueError: if not ``0 <= delay <= execute`` (the next decision would be due before the last one took
            effect), or (in an environment) ``execute + delay`` exceeds the length of predictions.
        KeyError: if :class:`ActionHistory` does not precede it, or a step's input lacks delay or history.
        RuntimeError: (on a step) if a decision executed more than ``execute`` actions.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import GaussianPrior, policy_transforms
        >>> from warmprior.transforms import executed_chunk
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
        history_key: NestedKey = keys.HISTORY,
    ) -> None:
        super().__init__(in_keys=[unravel_key((history_key, "forecast"))], out_keys=[keys.DELAY])
        check_delay(delay, execute)
        self.chunk_key, self.history_key = chunk_key, history_key
        self.delay = delay
        self.execute = execute

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        needed = (*self.in_keys, keys.DELAY, self.chunk_key)
        hint = ". Step with the chunk, from the last reset's or step's tensordict"
        check_keys(tensordict, needed, "InferenceDelay", hint)
        executed = executed_chunk(tensordict, self.chunk_key, self.history_key)
        return tensordict.set(self.chunk_key, executed)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        executed = next_tensordict.get(keys.EXECUTED)
        if (executed > self.execute).any():
            raise RuntimeError(
                f"a decision executed {int(executed.max())} actions, but InferenceDelay has "
                f"execute={self.execute}: give it the same number as ChunkStep"
            )
        next_tensordict.set(keys.DELAY, torch.full_like(executed, self.delay))
        return keep_resting(tensordict, next_tensordict, [keys.DELAY])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        shape = (*tensordict_reset.batch_size, 1)
        none = torch.zeros(shape, dtype=torch.int64, device=tensordict_reset.device)
        return tensordict_reset.set(keys.DELAY, none)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the delay."""
        (forecast,) = self.in_keys
        check_keys(observation_spec, [forecast], "InferenceDelay", ": append it after ActionHistory")
        check_unwritten(observation_spec, self.out_keys, "InferenceDelay")
        check_delay(self.delay, self.execute, observation_spec[forecast].shape[-2])
        observation_spec[keys.DELAY] = Unbounded(
            (*observation_spec.shape, 1), dtype=torch.int64, device=observation_spec.device
        )
        return observation_spec
