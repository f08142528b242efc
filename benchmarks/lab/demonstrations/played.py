"""Demonstrations by a saved policy: the episodes that it solves."""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lab.demonstrations.episodes import Episode, Recorder, check_file, seeds_of, write_robomimic
from lab.io.workers import available_cores, working
from warmprior import WarmPriorActor
from warmprior.checks import check_whole_numbers, given
from warmprior.envs import RobosuiteEnv
from warmprior.envs.description import environment_name, environment_of
from warmprior.envs.env_args import modernize_env_args
from warmprior.envs.robosuite_tasks import low_dim_keys
from warmprior.evaluation import play_episode
from warmprior.evaluation.parallel import base_of
from warmprior.io.extras import require
from warmprior.saving import load_policy


class PlayedPolicy:
    """A saved policy that plays recorded episodes of robosuite.

    Args:
        folder: folder of the policy.
        modules: modules to import first, which define its own prior, start point or network.

    Raises:
        ValueError: if the policy was made for another environment.
    """

    def __init__(self, folder: str | Path, modules: Sequence[str] = ()) -> None:
        for module in modules:
            importlib.import_module(module)
        self.actor: WarmPriorActor = load_policy(folder)
        self.env = environment_of(self.actor)
        self._simulator: Any = base_of(self.env)
        if not isinstance(self._simulator, RobosuiteEnv):
            raise ValueError(
                f"{folder} was made for {environment_name(self.actor)}, but episodes are robosuite's alone"
            )
        # Policies that see images read no poses of objects, which readers and the rendering expect.
        loop = self._simulator.loop
        keys = dict.fromkeys((*self._simulator.low_dim_keys, *low_dim_keys(len(loop.env.robots))))
        recorder: Any = Recorder(type(loop)(loop.env, tuple(keys)))
        self._simulator.loop = recorder

    @property
    def model_file(self) -> str:
        """The simulator's model as XML."""
        return str(self._simulator.loop.env.sim.model.get_xml())

    def play(self, seed: int, nfe: int | None) -> Episode:
        """Play the episode of a seed."""
        solved = play_episode(self.actor, self.env, seed, nfe=nfe).success
        return self._simulator.loop.episode(seed, success=solved)


def play_demonstrations(
    folder: str | Path,
    n: int = 200,
    seed: int = 1,
    *,
    path: str | Path,
    nfe: int | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    modules: Sequence[str] = (),
) -> Path:
    """Let a saved policy play, and write the episodes that it solves in robomimic's HDF5 layout.

    The file has the observations of the policy and of the task, and states, from which images can be
    rendered. Episode ``k`` plays simulator seed ``seed * 100_000 + k``, as those of
    :func:`~lab.demonstrations.scripted.generate.generate_demonstrations` do. The content does not depend on
    the number of workers.

    Args:
        folder: folder of the policy, made for an environment of robosuite.
        n: number of episodes to play.
        seed: 0 to 99; files of different seeds share no episode. Scripted training data have the seed 0, and
            held-out ones 50.
        path: file to write.
        nfe: network evaluations per chunk; the policy's own by default.
        overwrite: replace an existing file.
        workers: number of processes; ``None`` for one per available core.
        modules: modules to import first, which define the policy's own prior, start point or network.

    Raises:
        FileExistsError: if ``path`` exists.
        ValueError: if the policy was made for another environment, solves no episode, or an option is out of
            range.

    Examples:
        >>> from lab.demonstrations.played import play_demonstrations
        >>> play_demonstrations("policies/lift", 20, path="own.hdf5")  # doctest: +SKIP
        PosixPath('own.hdf5')
    """
    seeds, path = seeds_of(seed, n), Path(path)
    check_whole_numbers(**given(workers=workers))
    check_file(path, overwrite)
    require("h5py", "sim")
    here = PlayedPolicy(folder, modules)  # an error is better raised here than in a worker
    nfe = here.actor.sampling.evaluations(nfe)
    description: Any = here.actor.environment
    workers = min(n, workers or available_cores())
    state = str(folder), tuple(modules)

    def solved() -> Iterator[Episode]:
        found = 0
        with working(workers, state) as call, tqdm(total=n, desc="play", unit="ep") as bar:
            running, upcoming = deque[Any](), iter(seeds)
            for _ in seeds:
                while len(running) < 2 * workers and (following := next(upcoming, None)) is not None:
                    running.append(call(partial(_play, seed=following, nfe=nfe)))
                episode = running.popleft().result()
                bar.update()
                if episode.success:
                    found += 1
                    bar.set_postfix(solved=found, refresh=False)
                    yield episode
        if not found:
            raise ValueError(f"{folder} solves none of {n} episodes: play more, or train it further")

    write_robomimic(
        path,
        solved(),
        env_args=modernize_env_args(description["robosuite"]["env_args"]),
        model_file=here.model_file,
        seed=seed,
        attributes={"source": "policy"},
    )
    return path


_played = cache(PlayedPolicy)


def _play(state: tuple[str, tuple[str, ...]], seed: int, nfe: int) -> Episode:
    return _played(*state).play(seed, nfe)
