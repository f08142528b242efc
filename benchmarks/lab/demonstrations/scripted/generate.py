"""Demonstration files from the scripted experts, generated in parallel and reproducibly."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from torchrl._utils import logger
from tqdm import tqdm

from lab.demonstrations.episodes import (
    SEEDS_PER_FILE,
    Episode,
    Recorder,
    check_file,
    seeds_of,
    write_robomimic,
)
from lab.demonstrations.scripted.experts import EXPERTS
from lab.demonstrations.scripted.motion import ArmRunner
from lab.demonstrations.scripted.operators import OPERATORS, SKILLED, Demonstrator
from lab.io.workers import available_cores, working
from warmprior.checks import check_choice, check_whole_numbers, given
from warmprior.envs.control_loop import ControlLoop, StepLoop
from warmprior.envs.robosuite_tasks import get_task
from warmprior.envs.simulator import import_robosuite, make_simulator, task_env_args
from warmprior.io.extras import require
from warmprior.io.files import cache_folder

#: Part of every cached file's name; raised when the same arguments give other demonstrations.
GENERATOR_VERSION = 1
_STYLES = ("ph", "mh")
_EXTRA_KEYS = ("eef_quat_site", "gripper_qvel", "joint_pos", "joint_vel")
_HOLD = 6  # steps that the task must stay solved for before the episode ends


def expert_loop(task: str) -> ControlLoop:
    """Make the simulation that a task's expert acts in."""
    spec = get_task(task)
    extra = (f"robot{i}_{key}" for i in range(spec.arms) for key in _EXTRA_KEYS)
    return ControlLoop(make_simulator(task_env_args(task)), (*spec.low_dim_keys, *extra))


def operator_of(style: str, seed: int) -> int:
    """Return the index of the operator who plays a seed; in ``mh`` data operators take turns."""
    return seed % len(OPERATORS) if style == "mh" else 0


def run_episode(loop: StepLoop, task: str, style: str, seed: int) -> Episode:
    """Play one scripted episode in an :func:`expert_loop`; the same seed gives the same one.

    It ends six steps after the task is solved, when the plan is exhausted, or at the task's time limit.
    """
    index = operator_of(style, seed)
    operator = OPERATORS[index] if style == "mh" else SKILLED
    # The first number separates this stream from others with the same seed.
    person = Demonstrator(operator, np.random.default_rng([7919, seed]))
    recorder = Recorder(loop)
    recorder.reset(seed)
    runners = [ArmRunner(loop, arm, plan, person) for arm, plan in enumerate(EXPERTS[task](loop, person))]
    solved = 0
    for _ in range(get_task(task).horizon(style)):
        _, success = recorder.step(np.concatenate([runner.act() for runner in runners]))
        solved = solved + 1 if success else 0
        if solved >= _HOLD or (not success and all(runner.given_up for runner in runners)):
            break
    return recorder.episode(seed, success=solved > 0, operator=index, level=person.level)


def generate_demonstrations(
    task: str,
    style: str = "ph",
    n: int = 200,
    seed: int = 0,
    *,
    path: str | Path | None = None,
    overwrite: bool = False,
    workers: int | None = None,
) -> Path:
    """Generate successful scripted demonstrations in robomimic's HDF5 layout, and return the file's path.

    The file has states; :func:`lab.demonstrations.render.render_demonstrations` renders images from them.

    Episode ``k`` plays simulator seed ``seed * 100_000 + k``, and the first ``n`` that succeed are
    kept in that order. In ``mh`` data six operators take turns and contribute equally, as in the
    official files. The content does not depend on the number of workers. All seeds are smaller
    than :data:`~warmprior.options.defaults.EVALUATION_SEED`.

    Args:
        task: ``lift``, ``can``, ``square``, ``stack`` or ``transport``.
        style: ``"ph"`` for one skilled operator, ``"mh"`` for six operators with three levels of skill.
        n: number of demonstrations.
        seed: 0 to 99; files of different seeds share no episode.
        path: file to write. ``None`` for the cache (``$WARMPRIOR_CACHE``, or ``~/.cache/warmprior`` if
            that is not set), from which a file generated earlier with the same arguments is returned at once.
        overwrite: replace an existing file.
        workers: number of processes; ``None`` for one per available core.

    Raises:
        FileExistsError: if ``path`` exists.
        ValueError: if the task is unknown or has no scripted expert, or an option is out of range.
        RuntimeError: if the experts fail too often to reach ``n``.

    Examples:
        >>> from lab.demonstrations.scripted.generate import generate_demonstrations
        >>> path = generate_demonstrations("lift", n=20)  # doctest: +SKIP
        >>> path.name  # doctest: +SKIP
        'lift_ph_n20_seed0_v1.hdf5'
        >>> generate_demonstrations("tool_hang")
        Traceback (most recent call last):
            ...
        ValueError: there is no scripted expert for 'tool_hang'; only its official data exist: ...
    """
    get_task(task)
    if task not in EXPERTS:
        raise ValueError(
            f"there is no scripted expert for {task!r}; only its official data exist: fetch them "
            "(download_robomimic, or --download)"
        )
    check_choice("style", style, _STYLES)
    first = seeds_of(seed, n).start
    check_whole_numbers(**given(workers=workers))
    if path is None:
        name = f"{task}_{style}_n{n}_seed{seed}_v{GENERATOR_VERSION}.hdf5"
        path = cache_folder() / "scripted" / name
        if path.exists():
            return path
    path = Path(path)
    check_file(path, overwrite)
    require("h5py", "sim")
    import_robosuite()
    workers = min(n, workers or available_cores())
    with working(workers, task) as call, tqdm(total=n, desc=f"{task}/{style}", unit="demo") as bar:
        model_file = call(_model).result()
        write_robomimic(
            path,
            _successes(call, 2 * workers, style, n, first, bar.update),
            env_args=task_env_args(task),
            model_file=model_file,
            seed=seed,
            attributes={"source": "scripted", "generator_version": GENERATOR_VERSION},
        )
    return path


def _successes(
    call: Callable[[Callable[[str], Episode]], Future[Episode]],
    ahead: int,
    style: str,
    n: int,
    first: int,
    report: Callable[[int], Any],
) -> Iterator[Episode]:
    """Yield the first ``n`` successes in the order of their seeds, the same number from each operator."""
    operators = len(OPERATORS) if style == "mh" else 1
    remaining = [n // operators + (i < n % operators) for i in range(operators)]
    limit = min(SEEDS_PER_FILE, 20 * n + 100 * operators)
    upcoming = iter(range(first, first + limit))
    running: deque[Future[Episode]] = deque()
    played = 0
    while any(remaining):
        while len(running) < ahead:
            # Seeds of operators who have contributed enough are skipped, which does not change the result.
            following = next((s for s in upcoming if remaining[operator_of(style, s)]), None)
            if following is None:
                break
            running.append(call(partial(_play, style=style, seed=following)))
        if not running:
            raise RuntimeError(
                f"only {n - sum(remaining)} of {n} demonstrations succeeded in {played} episodes"
            )
        episode = running.popleft().result()
        played += 1
        if episode.success and remaining[episode.operator]:
            remaining[episode.operator] -= 1
            report(1)
            yield episode
    logger.info(f"{n} demonstrations from {played} scripted episodes")


@cache
def _loop(task: str) -> ControlLoop:
    """Return the simulation of a task, one per worker."""
    return expert_loop(task)


def _model(task: str) -> str:
    """Return the simulator's model as XML."""
    return str(_loop(task).env.sim.model.get_xml())


def _play(task: str, style: str, seed: int) -> Episode:
    return run_episode(_loop(task), task, style, seed)
