"""Which seed each row of a batched environment plays next."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torchrl.envs import EnvBase, ParallelEnv, SerialEnv

from warmprior.training.parallel import base_of


def row_seeding(env: EnvBase) -> Callable[[int, int], None]:
    """Return what to call with a row and the seed of its next episode, before that is reset."""
    base = base_of(env)
    if getattr(type(base), "strided_seeds", False):
        return lambda row, seed: None
    if not isinstance(base, (SerialEnv, ParallelEnv)):
        raise ValueError(
            f"{type(base).__name__} plays {env.batch_size[0]} episodes at once, and nothing tells which "
            "seed a row plays: evaluate a single one, or several in a SerialEnv, a ParallelEnv or "
            "warmprior.training.parallel_env. If its row i plays the seeds seed + i, seed + i + n, ... "
            "after set_seed(seed, static_seed=True), let its class say strided_seeds = True"
        )

    for make_env, options in zip(base.create_env_fn, base.create_env_kwargs, strict=True):
        if _has_offset(make_env) or options.get("seed_offset"):
            raise ValueError(
                "an environment built with a seed_offset does not play the seed that it is given: leave it "
                "out, or build all of them by warmprior.training.parallel_env"
            )
    rows = [base[row] for row in range(env.batch_size[0])]
    return lambda row, seed: rows[row].set_seed(seed, static_seed=True)


def _has_offset(make_env: object) -> bool:
    # Workers cannot be asked: one that lacks the attribute dies.
    if not isinstance(make_env, partial):
        return False
    return bool(make_env.keywords.get("seed_offset")) or any(
        _has_offset(inner) for inner in (make_env.func, *make_env.args, *make_env.keywords.values())
    )
