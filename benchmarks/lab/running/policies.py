"""Policies of a comparison: their folders, and the jobs that train and play them.

The name of a policy's folder contains a digest of everything that determines it, so runs with the same
options share it.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from torchrl.envs import EnvBase
from torchrl.record.loggers import get_logger

from lab.demonstrations.data_options import DataOptions, without_images
from lab.demonstrations.loading import load_task, longest_of, space_of, task_places, title_of
from lab.methods.methods import Method, code_digest
from lab.options.options import Evaluation, Options, Run, with_parts
from lab.options.stored_options import of_run, stored_options
from warmprior import WarmPriorActor
from warmprior.evaluation import Episode, play_episode
from warmprior.io.distributed import from_leader, leader_first, rank
from warmprior.io.files import digest_of, read_json, write_atomic
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state, run_identity
from warmprior.tasks import Task
from warmprior.training import NetworkOptions, TrainingConfig, train_policy
from warmprior.training.cloning import policy_path
from warmprior.training.networks import network_class


@dataclass(frozen=True)
class Policy:
    """A policy of a comparison, trained or not; worker processes build it from these options."""

    place: tuple[str | None, str]  # name and style of the task, for `load_task`
    data: DataOptions
    network: NetworkOptions
    method: Method
    training: TrainingConfig  # the recipe, seed included
    run: Run  # the run, with an absolute folder
    grid: str
    name: str = ""  # name of its folder
    identity: str = ""  # digest of its demonstrations
    facts: dict[str, Any] = field(default_factory=dict, compare=False)  # columns of all its rows

    @property
    def folder(self) -> Path:
        return self.run.policies / self.name

    def __str__(self) -> str:
        return f"{self.facts['task']} {self.facts['data']}, {self.method}, seed {self.training.seed}"

    @property
    def is_trained(self) -> bool:
        """Return True if its last policy is saved; files are written atomically."""
        return (policy_path(self.folder, self.training.iterations) / "model.safetensors").is_file()

    @property
    def status(self) -> Path:
        """Return the file with the progress and processor time of its training."""
        return self.folder / "status.json"

    def task(self) -> Task:
        """Return its task, read once per process; raise ValueError if it has other demonstrations."""
        task = cached_task(self.data, *self.place)
        if task.identity != self.identity:
            raise ValueError(
                f"the demonstrations of {title_of(task)} are others than when the run began: leave their "
                "files unchanged, and draw random ones with a seed"
            )
        return task

    def teacher(self) -> Policy | None:
        method = self.method.teacher
        return None if method is None else policy_of(self.task(), self, method)

    def load(self, checkpoint: int | None = None) -> WarmPriorActor:
        """Load the policy of averaged weights on the CPU, with this comparison's environment and grid."""
        path = policy_path(self.folder, checkpoint or self.training.iterations)
        network_class(self.network)  # a worker process has not imported it
        # Runs with another time limit share the file.
        policy = load_policy(path).replace(environment=self.task().environment)
        return policy.replace(grid=self.grid) if self.method.is_flow else policy

    @property
    def state(self) -> Path:
        """Return the file from which its training continues; a finished policy does not need it."""
        return self.folder / "state.safetensors"

    @property
    def losses(self) -> list[tuple[int, float]]:
        return load_state(self.state)[1]["losses"]

    @property
    def seconds(self) -> float | None:
        """Return the processor time of its training, including its teacher's; None if it is not trained."""
        teacher, seconds = self.teacher(), clock(self.status)
        of_teacher = 0.0 if teacher is None else teacher.seconds
        return None if seconds is None or of_teacher is None else seconds + of_teacher


cached_task = cache(load_task)


def facts_of(task: Task) -> dict[str, Any]:
    """Return a task's name and style, and the facts of its demonstrations."""
    return {"task": task.name, "data": task.style, **task.facts}


def policies_of(options: Options, *more: tuple[str, str], only: bool = False) -> list[Policy]:
    """Return a policy per task, recipe, method and seed, the first method's first.

    The tasks are those of the options and `more`; with `only` just `more`. Demonstrations are read,
    downloaded or generated.
    """
    run = replace(options.run, out=options.run.folder.absolute())
    with leader_first():  # other processes find the files of the first
        places = [*([] if only else task_places(options.data)), *more]
        tasks = {place: cached_task(options.data, *place) for place in places}
        names = [(task.name, task.style) for task in tasks.values()]
        if twice := [" ".join(name) for name in set(names) if names.count(name) > 1]:
            raise ValueError(
                f"--task: two tasks are called {twice[0]}: give one of them another name or style"
            )
    policies = []
    for place, task in tasks.items():
        network = options.network if task.images else without_images(options.network)
        for training in options.trainings():
            for method in options.sources.methods():
                if method.chunk_length > longest_of(task):
                    raise ValueError(
                        f"{method} predicts more steps than the longest demonstration of {title_of(task)} "
                        f"has, {longest_of(task)}: choose a shorter --chunk"
                    )
                for seed in options.seeds:
                    seeded, grid = replace(training, seed=seed), options.evaluation.grid
                    like = Policy(place, options.data, network, method, seeded, run, grid)
                    policies.append(policy_of(task, like, method))
    return list({policy.folder: policy for policy in policies}.values())


def policy_of(task: Task, like: Policy, method: Method) -> Policy:
    """Return the policy of another method on a task, with the options of the policy `like`."""
    identity = run_identity(
        task.identity,
        asdict(like.training),
        method=method.config(),
        network=asdict(like.network) | {"code": code_digest(network_class(like.network))},
        device=like.run.device,
        compile=like.run.compile,
        versions={name: version(name) for name in ("torch", "warmprior")},
    )
    source = slug(",".join(filter(None, (method.name, method.options))))
    name = f"{task.name}-{task.style}-{source}-seed{like.training.seed}-{digest_of(identity)[:10]}"
    facts = {
        "task": task.name,
        "data": task.style,
        **space_of(task),
        **method.facts,
        "seed": like.training.seed,
        "iterations": like.training.iterations,
    }
    return replace(like, method=method, name=name, identity=task.identity, facts={**facts, "policy": name})


def slug(text: str) -> str:
    """Return a text as part of a folder's name, different for every text."""
    plain = re.sub(r"[^\w.=+,-]+", "-", text, flags=re.ASCII)[:60]
    return plain if plain == text else f"{plain}-{digest_of(text)[:8]}"


def train(policy: Policy) -> None:
    """Train a policy that is not trained yet, and its teacher before.

    Other processes that train the same policy wait.
    """
    policy.folder.mkdir(parents=True, exist_ok=True)
    if (teacher := policy.teacher()) is not None:
        train(teacher)
    with FileLock(policy.folder / ".lock") if not rank() else nullcontext():
        if from_leader(lambda: policy.is_trained):
            clock(policy.status)  # if it is damaged, its rows alone are missing
            return
        task, method = policy.task(), policy.method
        # A worker sees only its own GPU.
        device = torch.device(policy.run.device).type
        training = method.recipe(policy.training)
        progress = status_writer(policy.status, training.iterations)
        logger, logs = None, str(policy.run.folder / "logs")
        if policy.run.logger != "none" and not rank():
            logger = get_logger(policy.run.logger, logger_name=logs, experiment_name=policy.name)
        # Every step draws a_0 from the prior; the loss is `warmprior.FlowMatchingLoss`.
        train_policy(
            task,
            method.prior(),
            policy.folder,
            network=policy.network,
            training=training,
            start=method.start(),
            coupling=method.coupling(teacher.load().to(device) if teacher else None),
            see_history=method.parts.sees_history,
            max_nfe=method.parts.played.get("nfe"),
            **method.parts.played,
            device=device,
            compile=policy.run.compile,
            logger=logger,
            description=None,
            progress=progress,
        )
        progress(training.iterations)  # the last policy is saved as well
    if torch.cuda.is_initialized():
        torch.cuda.empty_cache()  # for other workers on the same GPU


def clock(status: Path) -> float | None:
    """Return the processor time in a status file; None if there is no file."""
    if not status.exists():
        return None
    try:
        return float(read_json(status)["seconds"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{status} is damaged: remove it; the training then counts its time from 0 ({error})"
        ) from error


def status_writer(path: Path, iterations: int) -> Callable[[int], None]:
    """Return a function that writes the progress and total processor time of a training once a second."""
    began = time.process_time() - (clock(path) or 0.0)
    last_write = time.monotonic()

    def write(iteration: int) -> None:
        nonlocal last_write
        if rank() or (time.monotonic() - last_write < 1.0 and iteration < iterations):
            return
        last_write = time.monotonic()
        seconds = time.process_time() - began
        status = {"iteration": iteration, "iterations": iterations, "seconds": seconds}
        write_atomic(path, lambda path: path.write_text(json.dumps(status)))

    return write


def trained_actors(policies: Sequence[Policy], device: str) -> dict[Method, dict[int, WarmPriorActor]]:
    """Return the last policies by method and seed, without methods of which a seed failed."""
    seeds = {policy.training.seed for policy in policies}
    by_method: dict[Method, dict[int, WarmPriorActor]] = {}
    for policy in policies:
        if policy.is_trained:
            by_method.setdefault(policy.method, {})[policy.training.seed] = policy.load().to(device)
    return {method: actors for method, actors in by_method.items() if actors.keys() == seeds}


def finished_policies(run: Path, options: Options) -> list[Policy]:
    """Return the policies of a finished run for the methods that are asked for; its data are read again."""
    stored = of_run(options, run)
    policies = policies_of(with_parts(stored, evaluation={"grid": options.evaluation.grid}))
    methods = " ".join(stored_options(Options, run, None).sources.prior)
    for policy in policies:
        if not policy.is_trained:
            raise FileNotFoundError(
                f"--run {run} has no trained policy {policy} of these versions and data (options.json has "
                f"its own): finish it with --resume --out {run}, or name its methods: --prior {methods}"
            )
    return policies


@dataclass(frozen=True)
class Cell:
    """The settings with which a policy is played; the episodes of a cell make one row."""

    checkpoint: int  # iteration of the training at which the policy was saved
    nfe: int  # network evaluations per chunk
    delay: int | None = None  # control steps until a chunk takes effect; None if the simulator waits
    execute: int | None = None  # executed actions per decision; H by default
    guidance: RealTimeChunking | None = None
    temperature: float = 1.0  # factor of the source's noise

    def facts(self) -> dict[str, Any]:
        facts: dict[str, Any] = {
            "checkpoint": self.checkpoint,
            "nfe": self.nfe,
            "temperature": self.temperature,
        }
        if self.delay is not None:
            guidance = "none" if self.guidance is None else "rtc"
            facts |= {"execute": self.execute, "delay": self.delay, "guidance": guidance}
        return facts

    def __str__(self) -> str:
        return ", ".join(f"{name} {value}" for name, value in self.facts().items())


def play(policy: Policy, cell: Cell, evaluation: Evaluation, seeds: Sequence[int]) -> list[Episode]:
    """Play episodes; their noise depends on the seeds of policy and episode only."""
    actor, env = prepared(policy, replace(cell, nfe=1), evaluation.play_on)
    task = policy.task()
    outcome: dict[str, Any] = {"success": task.play.success, "measures": task.play.measures}
    outcome |= {"nfe": cell.nfe, "policy_seed": policy.training.seed}
    return [play_episode(actor, env, episode, **outcome) for episode in seeds]


@lru_cache(maxsize=1)
def prepared(policy: Policy, cell: Cell, play_on: bool) -> tuple[WarmPriorActor, EnvBase]:
    """Return a policy and its environment, kept for the next episodes of the same policy."""
    actor = policy.load(cell.checkpoint).replace(guidance=cell.guidance, temperature=cell.temperature)
    base = simulator((policy.data, *policy.place), play_on)
    return actor, policy.task().env(actor, base, execute=cell.execute, delay=cell.delay)


@lru_cache(maxsize=1)
def simulator(place: tuple[Any, ...], play_on: bool) -> EnvBase:
    """Return the environment of a task, kept for all policies, because building it takes a second."""
    return cached_task(*place).make_env(**({"terminate_on_success": False} if play_on else {}))
