"""Demonstrations by a saved policy: the episodes that it solves."""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path
from typing import Any, cast

from torchrl.envs import EnvBase
from tqdm import tqdm

from lab.demonstrations.episodes import SEEDS_PER_FILE, Episode, Recorder, successes, write_robomimic
from lab.io.workers import available_cores, working
from warmprior import WarmPriorActor
from warmprior.checks import check_between, check_whole_numbers, given
from warmprior.envs import RobosuiteEnv
from warmprior.envs.description import environment_name, environment_of
from warmprior.envs.env_args import modernize_env_args
from warmprior.evaluation import play_episode
from warmprior.evaluation.parallel import base_of
from warmprior.io.extras import require
from warmprior.options.defaults import EVALUATION_SEED
from warmprior.saving import load_policy


def play_demonstrations(
    folder: str | Path,
    n: int = 200,
    seed: int = 1,
    *,
    path: str | Path,
    nfe: int | None = None,
    overwrite: bool = False,
    workers: int | None = None,
) -> Path:
    """Let a saved policy play, and write what it solves as demonstrations in robomimic's HDF5 layout.

    The file has states, from which images can be rendered, and the observations of the policy's environment.
    Episode ``k`` plays simulator seed ``seed * 100_000 + k``, as in :func:`generate_demonstrations`, whose
    demonstrations of training have the seed 0, and the first ``n`` that succeed are kept in that order. The
    content does not depend on the number of workers.

    Args:
        folder: folder of the policy, made for an environment of robosuite.
        n: number of demonstrations.
        seed: 0 to 99; files of different seeds share no episode.
        path: file to write.
        nfe: network evaluations per chunk; the policy's own by default.
        overwrite: replace an existing file.
        workers: number of processes; ``None`` for one per available core.

    Raises:
        FileExistsError: if ``path`` exists.
        ValueError: if the policy was made for another environment, or an option is out of range.
        RuntimeError: if the policy fails too often to reach ``n``.

    Examples:
        >>> from lab.demonstrations.played import play_demonstrations
        >>> play_demonstrations("policies/lift", 20, path="own.hdf5")  # doctest: +SKIP
        PosixPath('own.hdf5')
    """
    check_between(0, EVALUATION_SEED // SEEDS_PER_FILE - 1, seed=seed)
    check_whole_numbers(n=n, **given(workers=workers, nfe=nfe))
    check_between(1, SEEDS_PER_FILE, n=n)
    path = Path(path)
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists: choose another file, or replace it (overwrite, --overwrite)")
    require("h5py", "sim")
    actor, env = _playing(str(folder))  # an error is better raised here than in a worker
    description: Any = actor.environment
    model_file = str(base_of(env).loop.env.sim.model.get_xml())
    workers = min(n, workers or available_cores())
    with working(workers, str(folder)) as call, tqdm(total=n, desc="play", unit="demo") as bar:
        write_robomimic(
            path,
            successes(call, partial(_play, nfe=nfe), 2 * workers, "ph", n, seed * SEEDS_PER_FILE, bar.update),
            env_args=modernize_env_args(description["robosuite"]["env_args"]),
            model_file=model_file,
            seed=seed,
            attributes={"source": "policy"},
        )
    return path


@lru_cache(maxsize=1)
def _playing(folder: str) -> tuple[WarmPriorActor, EnvBase]:
    """Return a policy, and its environment, whose simulator records."""
    actor = load_policy(folder)
    env = environment_of(actor)
    simulator: Any = base_of(env)
    if not isinstance(simulator, RobosuiteEnv):
        raise ValueError(
            f"{folder} was made for {environment_name(actor)}, and episodes of robosuite alone are written: "
            "evaluate() plays others, and demonstrations_of() takes what you record"
        )
    simulator.loop = cast(Any, Recorder(simulator.loop))
    return actor, env


def _play(folder: str, seed: int, nfe: int | None) -> Episode:
    actor, env = _playing(folder)
    played = play_episode(actor, env, seed, nfe=nfe)
    return base_of(env).loop.episode(seed, success=played.success)
