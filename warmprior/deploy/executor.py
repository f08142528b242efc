"""Execution of one action per control step while the next chunk is computed in parallel."""

from __future__ import annotations

import copy
import math
import warnings
from collections import deque
from collections.abc import Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotDone
from threading import RLock
from typing import Any, Self

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from warmprior import keys
from warmprior.checks import (
    check_between,
    check_finite,
    check_finite_numbers,
    check_not_negative,
    check_positive,
    check_shape,
    check_whole_numbers,
    given,
)
from warmprior.deploy.observation import RobotObservation, encoder_in, observation_shapes
from warmprior.history import caught_up, cold_history
from warmprior.modules.actor import check_usual_keys
from warmprior.modules.network import device_of, uncompiled
from warmprior.modules.normalize import Normalizer
from warmprior.modules.real_time_chunking import spliced
from warmprior.transforms.delay import check_delay, usual_execute
from warmprior.transforms.history import HistoryObservation

RECENT = 10
"""The number of recent delays, of which the largest is expected."""


class AsyncExecutor:
    """Runs a policy alongside a control loop: the next chunk is computed while the current one is executed.

    Every ``execute`` control steps a decision begins in a thread, with the observation of that step. Until
    its chunk is ready, the robot continues the old one; the new chunk takes effect at the position that the
    robot has reached. The policy assumes the largest recent delay (``("rtc", "delay")``, for
    :class:`~warmprior.RealTimeChunking`). At every decision, late or not, the history
    (:mod:`warmprior.history`) holds the last executed actions and the rest of the chunk, which is empty once
    the chunk is used up. :class:`~warmprior.InferenceDelay` does the same in simulation; with ``latency``
    both return the same actions.

    The first step of an episode waits for its chunk. Later, if no action is left and no chunk arrives
    within ``timeout`` seconds, :meth:`act` raises ``TimeoutError``: hold the robot, and retry.
    Several threads can share an executor: their calls take turns.

    The normaliser, the number of stacked observations, and the observations' names and sizes come from the
    policy. Camera images may have any size: they are resized as those of the training were, and the encoder
    takes the central crop. A warning, once each, names an image whose ratio of width to height is not the
    recorded one, and an observation far outside of the range of the demonstrations. Weights that are loaded
    into the policy are used from the next decision on, and a normaliser's statistics from the next
    :meth:`reset` on.

    Args:
        actor: a :class:`~warmprior.WarmPriorActor`, an :class:`ExportedPolicy`, a
            :class:`~warmprior.lerobot.LeRobotActor`, or any module
            that reads ``"observation"`` (or ``("prior", "observation")``, which includes the last actions),
            ``"history"`` and ``("rtc", "delay")``, writes a chunk ``[P, d_a]``, and has the attributes
            ``prior`` (only its lengths are used), ``action_dim`` and ``observation_steps`` (2 without it). It
            is set to evaluation mode, and called without batch dimensions.
        execute: control steps between decisions; by default ``H`` (of a LeRobot policy its
            ``n_action_steps``), or as many as ``delay`` allows.
        delay: expected delay before any is measured, in control steps, or in seconds with ``control_rate``;
            one control step by default.
        control_rate: control steps per second: those of the demonstrations, if the policy knows them.
        normalizer: converts raw observations and actions; the actor's own by default. Without one
            (``actor.replace(normalizer=None)``), both are in the policy's units.
        timeout: seconds to wait for a late chunk once no action is left; ``None`` waits without limit.
        latency: simulated delay: chunks are computed in the calling thread and take effect this many control
            steps later.

    Raises:
        ValueError: if numbers are inconsistent, the actor lacks an attribute or has keys of its own, or the
            normaliser lacks observations or actions.

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
        execute: int | None = None,
        delay: float | None = None,
        control_rate: float | None = None,
        normalizer: Normalizer | None = None,
        timeout: float | None = 0.0,
        latency: int | None = None,
    ) -> None:
        plain = uncompiled(actor)
        network = uncompiled(getattr(plain, "network", None))
        prior = getattr(plain, "prior", None)
        action_dim = getattr(plain, "action_dim", getattr(network, "action_dim", None))
        observation_steps: int = getattr(plain, "observation_steps", getattr(network, "observation_steps", 2))
        normalizer = getattr(plain, "normalizer", None) if normalizer is None else normalizer
        check_usual_keys(actor, "AsyncExecutor")
        if prior is None or action_dim is None:
            raise ValueError(f"{type(actor).__name__} needs the attributes prior and action_dim")
        check_whole_numbers(observation_steps=observation_steps, **given(execute=execute))
        check_whole_numbers(0, **given(latency=latency))
        check_not_negative(**given(timeout=timeout))
        check_positive(**given(control_rate=control_rate))
        recording = getattr(plain, "recording", None)
        rate = None if recording is None else recording.rate
        # Rates of cameras are rounded: 29.97 is 30.
        if control_rate and rate and not math.isclose(control_rate, rate, rel_tol=0.01):
            raise ValueError(
                f"control_rate={control_rate:g}, but the demonstrations have {rate:g} control steps per "
                "second, and actions are not resampled: run the loop at their rate"
            )
        length = prior.prediction_length
        expected = _steps(delay, control_rate) if latency is None else latency
        execute = usual_execute(plain, prior, expected) if execute is None else execute
        check_delay(expected, execute, length)
        check_between(1, prior.chunk_length, execute=execute)
        if normalizer is not None:
            normalizer.check_has(keys.ACTION)
        self.prior, self.execute, self.timeout, self.latency = prior, execute, timeout, latency
        self.actor = actor.eval()
        self._shape = (length, action_dim)
        # LeRobot's weights are not among the actor's.
        self._device = getattr(plain, "device", None) or device_of(actor)
        # Guidance raises an error for delays longer than its execution horizon.
        guidance = getattr(getattr(plain, "ode", None), "guidance", None)
        self._reach = getattr(guidance, "execution_horizon", None) or length
        self._statistics = normalizer
        self._normalizer = None if normalizer is None else copy.deepcopy(normalizer).to("cpu")
        self._postprocess = getattr(plain, "postprocess", None)
        self._observed = RobotObservation(
            observation_shapes(actor),
            self._normalizer,
            getattr(encoder_in(actor), "resize", "squeeze"),
            recording,
        )
        self._sees_history = keys.CONDITIONED in actor.in_keys
        self._thread = None
        if latency is None:
            self._thread = ThreadPoolExecutor(1, thread_name_prefix="warmprior-policy")
        self._expected = expected
        self._delays: deque[int] = deque(maxlen=RECENT)
        self._stacked = observation_steps
        self._frames: deque[Tensor | TensorDictBase] = deque(maxlen=observation_steps)
        self._lock = RLock()
        self._pending: Future[Tensor] | None = None
        self._closed = False
        self.reset()

    @property
    def delays(self) -> tuple[int, ...]:
        """The last decisions' delays in control steps, except each episode's first."""
        with self._lock:
            return tuple(self._delays)

    @property
    def expected_delay(self) -> int:
        """The delay that the next decision assumes: the largest of :attr:`delays`, or ``delay`` if empty."""
        return max(self.delays, default=self._expected)

    def reset(self) -> None:
        """Begin a new episode.

        A decision in progress runs to its end and advances the generator; its chunk is discarded.
        """
        with self._lock:
            if self._pending is not None:
                self._pending.cancel()
            self._pending, self._failed = None, False
            self._frames.clear()
            self._history = cold_history([], self.prior.history_length, *self._shape)
            # The chunk as it is executed from the last decision on, and its end.
            self._chunk, self._end, self._executed = self._history["forecast"], 0, 0

    def act(self, observation: Tensor | TensorDictBase | Mapping[str, Any]) -> Tensor:
        """Return this control step's action, ``[d_a]`` on the CPU, for a raw observation.

        The observation is a vector ``[d_o]``, or a dictionary or tensordict with the vector ``"state"`` and
        the policy's images under their names, uint8 ``[h, w, 3]`` or ``[3, h, w]``; other entries are
        ignored. The demonstrations' own names work as well: each observation of the vector, and
        ``"observation.images.front"`` for ``"front_image"``. NumPy arrays work too.

        Raises:
            KeyError: if an entry is missing; the executor's state is then unchanged.
            ValueError: if an entry has the wrong shape, holds NaN or infinity, or is not an image; the state
                is then unchanged.
            TimeoutError: if no action is left, and the next chunk is not ready in time.
            RuntimeError: if the executor is closed.
            Exception: the policy's own error, once no action is left. Until then, and at every further call,
                the decision is tried again.
        """
        with self._lock:
            if self._closed:
                raise RuntimeError("the executor is closed")
            if not self._frames and self._statistics is not None and self._normalizer is not None:
                # Others may have been loaded into the policy.
                self._normalizer.load_state_dict(self._statistics.state_dict())
            # An episode's first observation fills the stack.
            self._frames.extend([self._observed(observation)] * (1 if self._frames else self._stacked))
            self._collect()
            if self._pending is None and (self._failed or self._executed >= min(self.execute, self._end)):
                self._decide()
                self._collect()
            if not self._left:
                self._wait()
            action = self._chunk[self._executed]
            self._executed += 1
        if self._normalizer is not None:
            return self._normalizer.denormalize(TensorDict({keys.ACTION: action}))[keys.ACTION]
        action = action.clone()
        return action if self._postprocess is None else self._postprocess(action[None])[0].cpu()

    @property
    def _first(self) -> bool:
        """True if the current decision is the first of its episode."""
        return not self._history["steps"]

    @property
    def _left(self) -> int:
        """The number of actions that are left to execute."""
        return self._end - self._executed

    def _decide(self) -> None:
        """Begin a decision; the rest of the chunk moves to the positions of the new one.

        An error in it becomes the decision's result.
        """
        left = self._left
        if self._executed:
            self._history = caught_up(self._history, self._chunk, torch.tensor([self._executed]))
            # Fewer than a whole chunk if the last decision failed.
            self._history["forecast_steps"] = torch.tensor([left])
        self._chunk, self._end, self._executed = self._history["forecast"], left, 0
        self._failed = False
        decision: Future[Tensor] = Future()
        try:
            frames = torch.stack(list(self._frames))
            if isinstance(frames, TensorDictBase):
                frames.batch_size = []  # the steps belong to the entries
            delay = torch.tensor([min(self.expected_delay, left, self._reach)])
            data = TensorDict({keys.OBSERVATION: frames, keys.HISTORY: self._history, keys.DELAY: delay})
            if self._thread is None:
                decision.set_result(self._compute(data))
            else:
                decision = self._thread.submit(self._compute, data)
        except Exception as error:  # kept as the decision's result, as by a thread
            decision.set_exception(error)
        self._pending = decision

    @torch.no_grad()
    def _compute(self, data: TensorDictBase) -> Tensor:
        """Return the policy's chunk; this may run in another thread."""
        # Copied, because tensors of a loop under torch.inference_mode() have no gradients for guidance.
        data = data.clone()
        if self._sees_history:
            data = HistoryObservation()(data)
        chunk = self.actor(data.to(self._device))[keys.CHUNK]
        check_shape("the policy's chunk", chunk, self._shape)
        check_finite({"the policy's chunk": chunk}, "it is not executed")
        return chunk.to(self._chunk)

    def _collect(self) -> None:
        """Let the computed chunk take effect, if it is ready."""
        if self._pending is None or not self._pending.done():
            return
        try:
            chunk = self._pending.result()
        except BaseException as error:
            self._pending, self._failed = None, True
            # An interruption, such as SystemExit, is raised at once, and once.
            if not (isinstance(error, Exception) and self._left):
                raise
            warnings.warn(
                f"a decision failed ({error!r}): executing the {self._left} actions that are left, and "
                "trying again",
                stacklevel=3,
            )
            return
        latency = 0 if self.latency is None or self._first else self.latency
        if self._left and self._executed < latency:
            return
        if not self._first:
            self._delays.append(self._executed)
        self._chunk = spliced(chunk, self._chunk, torch.tensor([self._executed]))
        self._end, self._pending = len(chunk), None

    def _wait(self) -> None:
        """Wait for the chunk that is being computed."""
        assert self._pending is not None, "a decision has begun if no action is left"
        try:
            self._pending.exception(None if self._first else self.timeout)
        except NotDone as late:
            raise TimeoutError(
                f"no action is left after {self._executed} control steps and {self.timeout} s. Hold the "
                "robot and call again; execute fewer actions, or predict longer chunks"
            ) from late
        except CancelledError:  # by another thread that closes the executor
            pass
        self._collect()

    def close(self) -> None:
        """End the thread after the current decision."""
        self._closed = True
        if (pending := self._pending) is not None:
            pending.cancel()
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _steps(delay: float | None, control_rate: float | None) -> int:
    """Return a delay in control steps, converted from seconds if the rate is given."""
    if delay is None:
        return 1
    check_finite_numbers(delay=delay)
    if control_rate is None:
        if delay != int(delay):
            raise ValueError(
                f"delay must be a whole number of control steps, got {delay}: for seconds, give control_rate"
            )
        return int(delay)
    return math.ceil(round(delay * control_rate, 6))
