"""One action per control step, while the next chunk is computed in parallel."""

from __future__ import annotations

import copy
import warnings
from collections import deque
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotDone
from itertools import chain
from types import TracebackType
from typing import Self

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from warmprior import keys
from warmprior.checks import check_between, check_finite, check_shape, check_whole_numbers
from warmprior.history import advance, cold_history
from warmprior.modules.actor import WarmPriorActor, check_usual_keys
from warmprior.modules.network import uncompiled
from warmprior.modules.normalize import Normalizer
from warmprior.modules.prior import Prior
from warmprior.modules.real_time_chunking import with_leftover
from warmprior.transforms.delay import check_delay
from warmprior.transforms.history import HistoryObservation


class AsyncExecutor:
    """Runs a policy beside a control loop: computes the next chunk while this one is executed.

    Every ``execute`` control steps a decision begins in a thread, with the observation of that step. Until
    its chunk is ready the robot continues the old one; the new one takes effect at the position that the
    robot has reached. The largest delay of the last decisions is what the policy expects next (``("rtc",
    "delay")``, for :class:`~warmprior.RealTimeChunking`). The history (:mod:`warmprior.history`) holds the
    executed actions and the rest of the chunk. :class:`~warmprior.InferenceDelay` does the same in
    simulation: with ``latency`` the actions are equal.

    The first step of an episode waits for its chunk. Later, if no action is left, :meth:`act` waits for at
    most ``timeout`` seconds and raises ``TimeoutError``: hold the robot, and call it again.

    Args:
        actor: a :class:`~warmprior.WarmPriorActor`, or any module that reads ``"observation"`` (or
            ``("prior", "observation")``, which includes the last actions), ``"history"`` and ``("rtc",
            "delay")`` and writes a chunk ``[P, d_a]``; set to evaluation mode. It is called without batch
            dimensions.
        prior: the policy's prior, of which only the lengths matter; the actor's own by default.
        execute: control steps between decisions; by default ``H``, or as many as ``delay`` allows.
        delay: expected delay in control steps until delays were measured.
        window: how many last decisions to take the largest delay of.
        observation_steps: ``To``; that of the actor's network by default, or 2.
        normalizer: converts raw observations and actions, such as the actor's own; by default they are in the
            policy's units.
        timeout: seconds to wait for a late chunk once no action is left; ``None`` for as long as it takes.
        latency: to simulate: chunks are computed in the calling thread and take effect this many steps later.
        pool: where to compute; by default in one thread, which :meth:`close` ends.
        action_dim: ``d_a``; that of the actor's network by default.

    Raises:
        ValueError: for numbers that do not fit each other, or a missing argument that the actor does not
            provide.

    Examples:
        >>> import torch
        >>> from warmprior import PastPrior, RealTimeChunking, VelocityMLP, WarmPriorActor
        >>> from warmprior.deploy import AsyncExecutor
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 8), PastPrior(8), guidance=RealTimeChunking())
        >>> with AsyncExecutor(actor, execute=6, latency=2) as executor:
        ...     actions = [executor.act(torch.zeros(3)) for _ in range(21)]
        >>> actions[0].shape, executor.delays
        (torch.Size([2]), (2, 2, 2))
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        *,
        prior: Prior | None = None,
        execute: int | None = None,
        delay: int = 1,
        window: int = 10,
        observation_steps: int | None = None,
        normalizer: Normalizer | None = None,
        timeout: float | None = 0.0,
        latency: int | None = None,
        pool: Executor | None = None,
        action_dim: int | None = None,
    ) -> None:
        if isinstance(plain := uncompiled(actor), WarmPriorActor):
            prior = plain.prior if prior is None else prior
            network = uncompiled(plain.network)
            if action_dim is None:
                action_dim = getattr(network, "action_dim", None)
            if observation_steps is None:
                observation_steps = getattr(network, "observation_steps", None)
        observation_steps = 2 if observation_steps is None else observation_steps
        check_usual_keys(actor, "AsyncExecutor")
        if prior is None or action_dim is None:
            raise ValueError(f"{type(actor).__name__} needs prior and action_dim")
        if latency is not None:
            if pool is not None:
                raise ValueError("a simulated latency computes in the calling thread: leave out pool")
            delay = latency
        check_whole_numbers(window=window, observation_steps=observation_steps)
        length = prior.prediction_length
        if execute is None:
            execute = min(prior.chunk_length, length - delay)
        check_delay(delay, execute, length)
        check_whole_numbers(execute=execute)
        check_between(1, prior.chunk_length, execute=execute)
        self.prior, self.execute, self.timeout, self.latency = prior, execute, timeout, latency
        self.actor = actor.eval()
        self._shape = (length, action_dim)
        self._device = next(
            (value.device for value in chain(actor.parameters(), actor.buffers())), torch.device("cpu")
        )
        self._normalizer = None if normalizer is None else copy.deepcopy(normalizer).to("cpu")
        self._sees_history = keys.CONDITIONED in actor.in_keys
        self._owned = None
        if pool is None and latency is None:
            self._owned = pool = ThreadPoolExecutor(1, thread_name_prefix="warmprior-policy")
        self._pool = pool
        self._expected = delay
        self._delays: deque[int] = deque(maxlen=window)
        self._frames: deque[Tensor | TensorDictBase] = deque(maxlen=observation_steps)
        self._closed = False
        self.reset()

    @property
    def delays(self) -> tuple[int, ...]:
        """Delays of the last decisions in control steps, without first decisions."""
        return tuple(self._delays)

    @property
    def expected_delay(self) -> int:
        """The delay that the next decision expects, the largest of :attr:`delays` or else ``delay``."""
        return max(self._delays, default=self._expected)

    def reset(self) -> None:
        """Begin another episode.

        A decision under way runs to its end, advances the generator and is discarded.
        """
        pending: Future[Tensor] | None = getattr(self, "_pending", None)
        if pending is not None:
            pending.cancel()
        self._pending: Future[Tensor] | None = None
        self._failed = False
        self._frames.clear()
        self._history = cold_history([], self.prior.history_length, *self._shape)
        # The chunk as it is executed from the last decision on, and how much of it there is.
        self._chunk, self._left, self._executed = self._history["forecast"], 0, 0

    def act(self, observation: Tensor | TensorDictBase) -> Tensor:
        """Return this control step's action, ``[d_a]`` on the CPU, for a raw observation.

        That is ``[d_o]``, or a tensordict ``[]`` with several entries.

        Raises:
            TimeoutError: if no action is left, and the next chunk is not ready in time.
            RuntimeError: after :meth:`close`.
            Exception: the policy's own error, once no action is left. Until then, and at every further call,
                the decision is tried again.
        """
        if self._closed:
            raise RuntimeError("the executor is closed")
        self._see(observation)
        self._collect()
        if self._pending is None and (self._failed or self._executed >= min(self.execute, self._left)):
            self._decide()
            self._collect()
        if self._executed >= self._usable:
            self._wait()
            if self._failed:  # the history remembers no more than what has been executed
                self._decide()
                self._collect()
        action = self._chunk[self._executed]
        self._executed += 1
        if self._normalizer is None:
            return action.clone()
        return self._normalizer.denormalize(TensorDict({keys.ACTION: action}))[keys.ACTION]

    @property
    def _first(self) -> bool:
        """Whether the decision under way is the first of its episode."""
        return not self._history["steps"]

    @property
    def _usable(self) -> int:
        """Actions that can be executed before another chunk is needed."""
        # A forecast has to reach P - H steps, as in training.
        return self._left if self._pending is None else min(self._left, self.prior.chunk_length)

    def _see(self, observation: Tensor | TensorDictBase) -> None:
        if self._normalizer is not None:
            data = TensorDict({keys.OBSERVATION: observation})
            observation = self._normalizer.normalize(data)[keys.OBSERVATION]
        observation = observation.clone()  # drivers may reuse the memory for the next one
        self._frames.append(observation)
        while len(self._frames) < (self._frames.maxlen or 0):
            self._frames.append(observation)

    def _decide(self) -> None:
        """Begin a decision; the rest of the chunk moves to the positions of the new one."""
        if self._left:
            self._history = advance(self._history, self._chunk, torch.tensor([self._executed]))
            # Less than a whole chunk where the last decision failed.
            self._history["forecast_steps"] = torch.tensor([self._left - self._executed])
        self._chunk, self._executed, self._failed = self._history["forecast"], 0, False
        self._left = int(self._history["forecast_steps"])
        frames = torch.stack(list(self._frames))
        if isinstance(frames, TensorDictBase):
            frames.batch_size = []  # the steps belong to the entries
        delay = torch.tensor([min(self.expected_delay, self._left)])
        data = TensorDict({keys.OBSERVATION: frames, keys.HISTORY: self._history, keys.DELAY: delay})
        if self._pool is None:
            self._pending = Future()
            try:
                self._pending.set_result(self._compute(data))
            except Exception as error:  # as a thread would keep it
                self._pending.set_exception(error)
        else:
            self._pending = self._pool.submit(self._compute, data)

    @torch.no_grad()
    def _compute(self, data: TensorDictBase) -> Tensor:
        """The policy's chunk, in whichever thread."""
        # Tensors of its own: those of a loop under torch.inference_mode() have no gradients for guidance.
        data = data.clone()
        if self._sees_history:
            data = HistoryObservation()(data)
        chunk = self.actor(data.to(self._device)).get(keys.CHUNK)
        if chunk is None:
            raise ValueError(f"the policy wrote no chunk at {keys.CHUNK}")
        check_shape("the policy's chunk", chunk, self._shape)
        check_finite({"the policy's chunk": chunk}, "it is not executed")
        return chunk.to(self._chunk)

    def _collect(self) -> None:
        """Let the chunk under way take effect, if it is ready."""
        if self._pending is None or not self._pending.done():
            return
        if (error := self._pending.exception()) is not None:
            self._pending, self._failed = None, True
            if self._executed < self._left:
                warnings.warn(
                    f"a decision failed ({error!r}): executing the {self._left - self._executed} actions "
                    "that are left, and trying again",
                    stacklevel=3,
                )
                return
            raise error
        latency = 0 if self.latency is None or self._first else self.latency
        if self._executed < min(latency, self._left):
            return
        chunk = self._pending.result()
        self._chunk = with_leftover(chunk, self._chunk, torch.tensor([self._executed]))
        self._left, self._pending = self._shape[0], None
        if not self._first:
            self._delays.append(self._executed)

    def _wait(self) -> None:
        """Wait for the chunk under way."""
        if self._pending is not None:
            try:
                self._pending.exception(None if self._first else self.timeout)
            except NotDone as late:
                raise TimeoutError(
                    f"no action is left after {self._executed} control steps and {self.timeout} s. Hold the "
                    "robot and call again; execute fewer actions, or predict longer chunks"
                ) from late
        self._collect()

    def close(self) -> None:
        """End the thread, after a decision under way; a pool that was given is left as it is."""
        self._closed = True
        if self._pending is not None:
            self._pending.cancel()
        if self._owned is not None:
            self._owned.shutdown(cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
