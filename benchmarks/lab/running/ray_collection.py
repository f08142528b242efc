"""Transitions from many machines, by TorchRL's collector on Ray."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from lab.io.ray_cluster import ray_cluster
from warmprior.io.workers import WorkerError, stop_forking
from warmprior.rl.agent import WarmUpSwitch

EPISODES_APART = 10_000
"""Distance between the seeds of two collectors."""


def _actor_class() -> type:
    """Return the class of an actor: TorchRL's collector, adapted to Ray."""
    from torchrl.collectors import Collector

    class Actor(Collector):
        def __repr__(self) -> str:  # Ray writes it before every line that an actor prints
            return "collector"

        def __bool__(self) -> bool:  # Ray asks for it, and the infinite length would raise
            return True

    return Actor


def _make_env(make_env: Callable[[int], EnvBase], seed: int, path: list[str]) -> EnvBase:
    """Make the environment of an actor, in its process, and seed its draws."""
    stop_forking()
    sys.path.extend(place for place in path if place not in sys.path)
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    return make_env(seed)


@contextmanager
def ray_rounds(
    policy: WarmUpSwitch,
    make_env: Callable[[int], EnvBase],
    *,
    collectors: int,
    num_envs: int,
    seed: int,
    address: str | None = None,
) -> Iterator[Iterator[TensorDictBase]]:
    """Yield rounds of decisions, ``[collectors, num_envs, 1]``: one per environment of several Ray actors.

    Before every round all actors receive the current weights of ``policy``; a round waits for the slowest.
    Actor ``i`` has a CPU and draws from ``seed + 10_000 * i``, so the same arguments give the same decisions
    on any number of machines.

    Raises:
        ValueError: if the cluster has too few CPUs.
        WorkerError: if an actor dies or its environment fails.
    """
    with ray_cluster(address, collectors) as ray:
        from torchrl.collectors.distributed import RayCollector

        cores = int(ray.cluster_resources().get("CPU", 0))
        if cores < collectors:
            raise ValueError(
                f"--collectors {collectors} need a CPU each, and the cluster has {cores}: choose fewer"
            )
        makers: list[Any] = [
            partial(_make_env, make_env, seed + EPISODES_APART * i, list(sys.path)) for i in range(collectors)
        ]
        collector = None
        try:
            collector = RayCollector(
                makers,
                copy.deepcopy(policy).to("cpu"),
                collector_class=_actor_class(),
                collector_kwargs={"auto_register_policy_transforms": False},
                frames_per_batch=collectors * num_envs,
                total_frames=sys.maxsize,
                exploration_type=ExplorationType.RANDOM,
                remote_configs={"num_cpus": 1, "num_gpus": 0},
                device="cpu",
                sync=True,
            )
            yield _rounds(collector, policy)
        except ray.exceptions.RayError as error:
            cause = getattr(error, "cause", None) or error
            raise WorkerError(f"a Ray collector failed: {str(cause).splitlines()[0]}") from error
        finally:
            if collector is not None:
                collector.shutdown()


def _rounds(collector: Any, policy: WarmUpSwitch) -> Iterator[TensorDictBase]:
    rounds = None
    while True:
        collector.update_policy_weights_(TensorDict.from_module(policy).data.to("cpu"))
        rounds = iter(collector) if rounds is None else rounds
        yield next(rounds)
