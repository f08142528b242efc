"""Environments in worker processes: which episodes their rows play, and an error if a worker dies."""

from __future__ import annotations

import copy
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, override

from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose

from warmprior.checks import check_whole_numbers
from warmprior.io.workers import WorkerError, dead_worker_error, end_with_parent, start_method
from warmprior.transforms.normalize import FollowsNormalizer
from warmprior.transforms.policy import PolicyEnv


class _NumberedEnv(PolicyEnv):
    """The environment of worker ``first`` of ``number``, which plays every ``number``-th seed."""

    first, number = 0, 1
    _next = 0

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        self._next = self.first + (seed or 0)
        return super().set_seed(seed, static_seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self.base_env.set_seed(self._next, static_seed=True)
        self._next += self.number
        return super()._reset(tensordict, **kwargs)


def _transformed(
    make_env: Callable[[], EnvBase],
    make_transforms: Callable[[], Compose],
    first: int,
    number: int,
    parent: int,
) -> EnvBase:
    end_with_parent(parent)  # TorchRL also builds one in the parent itself
    env = _NumberedEnv(make_env(), make_transforms())
    env.first, env.number, env._next = first, number, first
    return env


class _StridedEnv(ParallelEnv):
    """Environments whose workers number their own episodes (:class:`_NumberedEnv`)."""

    strided_seeds = True
    make_transforms: Callable[[], Compose]
    started: list[FollowsNormalizer]
    """The normalising transforms as the workers have them, which follow no policy of this process."""

    @override
    def _start_workers(self) -> None:
        parts = self.make_transforms().modules()
        self.started = [copy.deepcopy(part) for part in parts if isinstance(part, FollowsNormalizer)]
        try:
            super()._start_workers()
        except (ConnectionError, EOFError) as error:
            raise WorkerError(
                "a worker ended before it had built its environment, which this process can build; its own "
                "error, if it had one, is above. Workers that are spawned, as with a GPU, know what "
                "modules do as they are imported, and nothing else of this process: do there what the "
                "environment needs"
            ) from error


def parallel_env(
    make_env: Callable[[], EnvBase], make_transforms: Callable[[], Compose], num_envs: int
) -> ParallelEnv:
    """Return environments in worker processes, with the policy's transforms inside the workers.

    Whole chunks are executed inside a worker, so there is one exchange per decision. Worker ``i`` of ``n``
    plays the episodes of the seeds ``seed + i``, ``seed + i + n``, ... after ``set_seed(seed,
    static_seed=True)``, and those of seed 0 before it: it seeds its environment at every reset.

    Args:
        make_env: builds an environment, called without arguments in each worker. It must start the same
            episode after every ``set_seed(seed)``, and start no processes of its own.
        make_transforms: builds the policy's transforms, see :func:`~warmprior.policy_transforms`.
        num_envs: number of workers, at least 1.

    Examples:
        >>> from functools import partial
        >>> from warmprior import PastPrior, policy_transforms
        >>> from warmprior.envs import NavigationEnv
        >>> from warmprior.evaluation import parallel_env
        >>> make_transforms = partial(policy_transforms, PastPrior(8), observation_steps=1)
        >>> env = parallel_env(NavigationEnv, make_transforms, num_envs=2)
        >>> env.batch_size, env.is_closed  # the workers start with the first reset
        (torch.Size([2]), True)
    """
    check_whole_numbers(num_envs=num_envs)
    common = make_env, make_transforms
    workers = [partial(_transformed, *common, i, num_envs, os.getpid()) for i in range(num_envs)]
    # No shared buffers: with them the parent polls, and takes a core from the workers. Daemons, because
    # Python waits at its end for processes that are none.
    env = _StridedEnv(num_envs, workers, mp_start_method=start_method(), use_buffers=False, daemon=True)
    env.make_transforms = make_transforms
    return env


def transforms_of(env: EnvBase) -> Iterator[nn.Module]:
    """Yield an environment's transforms and their parts, innermost first, but those only its workers know."""
    if isinstance(env, TransformedEnv):
        yield from transforms_of(env.base_env)
        yield from env.transform.modules()
    elif isinstance(env, _StridedEnv):
        started = iter([] if env.is_closed else env.started)
        for part in env.make_transforms().modules():
            yield next(started, part) if isinstance(part, FollowsNormalizer) else part


def base_of(env: EnvBase) -> EnvBase:
    """Return the environment below all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def row_seeding(env: EnvBase) -> Callable[[int, int], None]:
    """Return a function that sets the seed of a row's next episode, to be called before its reset.

    Raises ValueError if the rows of the environment cannot be seeded.
    """
    base = base_of(env)
    if getattr(type(base), "strided_seeds", False):
        return lambda row, seed: None
    if not isinstance(base, (SerialEnv, ParallelEnv)):
        raise ValueError(
            f"the seeds that the {env.batch_size[0]} rows of {type(base).__name__} play are unknown: put "
            "single environments into a SerialEnv, a ParallelEnv or parallel_env; or, if set_seed(seed, "
            "static_seed=True) lets row i play seed + i, seed + i + n, ..., set strided_seeds in its class"
        )
    rows = [base[row] for row in range(env.batch_size[0])]
    return lambda row, seed: rows[row].set_seed(seed, static_seed=True)


@contextmanager
def watched(env: EnvBase) -> Iterator[None]:
    """Raise an error if a worker dies, because TorchRL would wait for it for hours."""
    base = base_of(env)
    if isinstance(base, ParallelEnv) and base.is_closed:
        base.start()
    workers = list(base._workers) if isinstance(base, ParallelEnv) else []
    finished = threading.Event()
    dead, code = "", 0
    # TorchRL closes the other processes when it finds a dead worker, and closed ones raise ValueError.
    closed_by_torchrl = suppress(ValueError)

    def each(call: Callable[[Any], object]) -> None:
        for worker in workers:
            with closed_by_torchrl:
                call(worker)

    def look() -> None:
        nonlocal dead, code
        ended = []
        for i, worker in enumerate(workers):
            with closed_by_torchrl:
                if not worker.is_alive():
                    ended.append((worker.exitcode == -signal.SIGTERM, i, worker.exitcode))
        if ended and not dead:  # TorchRL terminates the others, so one that ended differently died first
            _, i, code = min(ended)
            dead = f"worker {i} of {len(workers)} (exit code {code})"

    def watch() -> None:
        while not finished.wait(0.5):
            look()
            if dead:
                each(lambda worker: worker.terminate())  # closes the pipes that the parent waits on
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            each(lambda worker: worker.terminate())  # a step may take long
            raise
        if isinstance(error, (ConnectionError, EOFError)):
            each(lambda worker: worker.join(0.2))  # TorchRL may notice before the process is reaped
        look()
        finished.set()
        # Without this, idle workers would keep the interpreter from exiting.
        try:
            env.close(raise_if_closed=False)
        except Exception:  # closing fails if workers are dead
            each(lambda worker: worker.terminate())
        if dead:
            raise dead_worker_error(
                dead, "run one environment in this process to see its own error", code
            ) from error
        raise
    finally:
        finished.set()
        watcher.join()
