"""Rows of a batched environment get the seeds of their next episodes, which `episodes.py` chooses."""

from __future__ import annotations

from collections.abc import Callable

from torchrl.envs import EnvBase, ParallelEnv, SerialEnv

from warmprior.evaluation.parallel import base_of


def row_seeding(env: EnvBase) -> Callable[[int, int], None]:
    """Return a function that sets the seed of a row's next episode, to be called before its reset."""
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
