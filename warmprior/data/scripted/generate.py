"""Generates demonstration files from the scripted experts, in parallel and reproducibly."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

from torchrl._utils import logger

from warmprior.data.scripted.episode import (
    PLANS,
    Episode,
    expert_loop,
    operator_of,
    run_episode,
)
from warmprior.data.scripted.operators import OPERATORS
from warmprior.data.scripted.writer import write_robomimic
from warmprior.envs.control_loop import ControlLoop
from warmprior.envs.simulator import import_robosuite, task_env_args
from warmprior.envs.tasks import EVALUATION_SEED, get_task
from warmprior.io.extras import require
from warmprior.io.processes import end_with_parent

__all__ = ["GENERATOR_VERSION", "SEEDS_PER_FILE", "generate_demonstrations"]

#: Part of every cached file's name; raised whenever the same arguments give other demonstrations.
GENERATOR_VERSION = 1
#: A file of ``seed`` uses the simulator seeds from ``seed * SEEDS_PER_FILE`` on, at most this many.
SEEDS_PER_FILE = 100_000
_STYLES = ("ph", "mh")


def generate_demonstrations(
    task: str,
    style: str = "ph",
    n: int = 200,
    seed: int = 0,
    *,
    path: str | Path | None = None,
    cache_dir: str | Path | None = None,
    workers: int | None = None,
    progress: bool = True,
    image_size: int = 0,
) -> Path:
    """Generate successful scripted demonstrations in robomimic's HDF5 layout.

    Episode ``k`` plays simulator seed ``seed * 100_000 + k``, and the first ``n`` that succeed are
    kept in that order. In ``mh`` data six operators take turns and contribute equally, as in the
    official files. The content does not depend on the number of workers. All seeds are smaller
    than :data:`~warmprior.envs.tasks.EVALUATION_SEED`.

    Args:
        task: ``lift``, ``can``, ``square``, ``stack`` or ``transport``.
        style: ``"ph"`` for one skilled operator, ``"mh"`` for six of three levels.
        n: number of demonstrations.
        seed: 0 to 99; files of different seeds share no episode.
        path: where to write, replacing what is there. ``None`` for the cache, from which a file
            generated earlier with the same arguments is returned at once.
        cache_dir: ``None`` for ``$WARMPRIOR_CACHE``, or ``~/.cache/warmprior`` if that is not set.
        workers: number of processes; ``None`` for one per available core.
        progress: show a bar with the remaining time.
        image_size: side of the images of the task's cameras, in pixels; 0 for state only.

    Returns:
        The path of the complete file.

    Raises:
        ImportError: if robosuite, h5py or tqdm is not installed.
        ValueError: if the task is unknown or has no scripted expert, or an option is out of range.
        RuntimeError: if the experts fail too often to reach ``n``.

    Examples:
        >>> path = generate_demonstrations("lift", n=20)  # doctest: +SKIP
        >>> path.name  # doctest: +SKIP
        'lift_ph_n20_seed0_v1.hdf5'
    """
    spec = get_task(task)
    if not spec.scripted or task not in PLANS:
        raise ValueError(
            f"there is no scripted expert for {task!r}; only its official data exist: pass "
            "download=True to the dataset"
        )
    if style not in _STYLES:
        raise ValueError(f"style is {' or '.join(map(repr, _STYLES))}, got {style!r}")
    last_seed = EVALUATION_SEED // SEEDS_PER_FILE - 1
    if not 0 <= seed <= last_seed:
        raise ValueError(f"seed must be between 0 and {last_seed}, got {seed}")
    for name, value, least in (("n", n, 1), ("workers", workers, 1), ("image_size", image_size, 0)):
        if value is not None and value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    if path is None:
        suffix = f"_image{image_size}" if image_size else ""
        name = f"{task}_{style}_n{n}_seed{seed}{suffix}_v{GENERATOR_VERSION}.hdf5"
        path = _cache_folder(cache_dir) / "scripted" / name
        if path.exists():
            return path
    path = Path(path)
    for module in ("h5py", "tqdm"):
        require(module, "sim")
    import_robosuite()
    workers = min(n, workers or _available_cores())
    with contextlib.ExitStack() as stack:
        play = stack.enter_context(_players(task, style, image_size, workers))
        bar = stack.enter_context(
            require("tqdm", "sim").tqdm(
                total=n, desc=f"{task}/{style}", unit="demo", disable=not progress
            )
        )
        model_file = play(None).result()
        write_robomimic(
            path,
            _successes(play, style, n, seed * SEEDS_PER_FILE, 2 * workers, bar.update),
            env_args=task_env_args(task, image_size),
            model_file=model_file,
            seed=seed,
            attributes={"source": "scripted", "generator_version": GENERATOR_VERSION},
        )
    return path


_LINUX = sys.platform.startswith("linux")
_Play = Callable[[int | None], "Future[Any]"]


def _available_cores() -> int:
    return len(os.sched_getaffinity(0)) if _LINUX else os.cpu_count() or 1


def _cache_folder(cache_dir: str | Path | None) -> Path:
    folder = cache_dir or os.environ.get("WARMPRIOR_CACHE") or Path.home() / ".cache" / "warmprior"
    return Path(folder).expanduser()


def _successes(
    play: _Play, style: str, n: int, first: int, ahead: int, report: Callable[[int], Any]
) -> Iterator[Episode]:
    """Yield the first ``n`` successes in seed order, the same number from each operator."""
    operators = len(OPERATORS) if style == "mh" else 1
    wanted = [n // operators + (i < n % operators) for i in range(operators)]
    limit = min(SEEDS_PER_FILE, 20 * n + 100 * operators)
    upcoming = iter(range(first, first + limit))
    running: deque[Future[Episode]] = deque()
    played = 0
    while any(wanted):
        while len(running) < ahead:
            # Whoever has contributed enough is skipped, which never changes what is kept.
            following = next((s for s in upcoming if wanted[operator_of(style, s)]), None)
            if following is None:
                break
            running.append(play(following))
        if not running:
            raise RuntimeError(
                f"only {n - sum(wanted)} of {n} demonstrations succeeded in {played} episodes"
            )
        episode = running.popleft().result()
        played += 1
        if episode.success and wanted[episode.operator]:
            wanted[episode.operator] -= 1
            report(1)
            yield episode
    for future in running:
        future.cancel()
    logger.info(f"{n} demonstrations from {played} scripted episodes")


@contextlib.contextmanager
def _players(task: str, style: str, image_size: int, workers: int) -> Iterator[_Play]:
    """Give a function that starts an episode by seed, or reads the model's XML for ``None``."""
    if workers == 1:
        player = _Player(task, style, image_size)

        def play_here(seed: int | None) -> Future[Any]:
            future: Future[Any] = Future()
            future.set_result(player(seed))
            return future

        yield play_here
        return
    # Forking needs neither another import of torch nor a __main__ guard in the caller's script,
    # and the children use nothing that has threads.
    context = multiprocessing.get_context("fork" if _LINUX else "spawn")
    pool = ProcessPoolExecutor(workers, context, _start_worker, (task, style, image_size))

    def play_there(seed: int | None) -> Future[Any]:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*fork.*", DeprecationWarning)
            return pool.submit(_work, seed)

    try:
        yield play_there
    except BaseException:  # Ctrl-C included: nobody waits for episodes that are under way
        for process in list((pool._processes or {}).values()):
            process.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class _Player:
    """One simulation and the episodes played in it."""

    def __init__(self, task: str, style: str, image_size: int) -> None:
        self.task, self.style, self.image_size = task, style, image_size
        self.loop: ControlLoop = expert_loop(task)

    def __call__(self, seed: int | None) -> Any:
        if seed is None:
            return self.loop.env.sim.model.get_xml()
        return run_episode(self.loop, self.task, self.style, seed, self.image_size)


_player: _Player | None = None


def _start_worker(task: str, style: str, image_size: int) -> None:
    global _player
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent ends its workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    end_with_parent()
    _player = _Player(task, style, image_size)


def _work(seed: int | None) -> Any:
    assert _player is not None
    return _player(seed)
