"""Trained policies on disk, found again by everything that determines them."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torchrl.record.loggers import get_logger

from warmprior.experiments.learned_sources import Learner, learn
from warmprior.experiments.methods import Method
from warmprior.experiments.problem import Problem
from warmprior.experiments.recipe import NetworkOptions, Recipe, RunOptions, check_images
from warmprior.io.distributed import leader_first, mean_over_processes, rank, world_size
from warmprior.io.files import check_writable, digest_of, read_json, write_atomic
from warmprior.modules.actor import WarmPriorActor
from warmprior.objectives.couplings import Coupling
from warmprior.training.behaviour_cloning import (
    STATE_FORMAT,
    BehaviourCloning,
    policy_path,
    precondition,
)
from warmprior.training.checkpoint import (
    check_identity,
    load_state,
    module_tensors,
    restore_module,
    restoring,
    save_state,
)
from warmprior.training.placement import placed
from warmprior.training.saved import load_policy
from warmprior.training.threads import torch_threads
from warmprior.training.training_config import TrainingConfig
from warmprior.transforms import policy_transforms

__all__ = ["Store", "finished_policies", "finished_problem"]

Losses = list[tuple[int, float]]

TIME = "training_time.json"

LEARNING_SHARE = 0.25
"""Gradient steps of priors that learn before the flow, per step of the flow."""


@dataclass
class Store:
    """Policies that differ in their source and recipe alone, trained on one problem.

    Each lies in a folder named by a digest of everything that determines it (data, recipe, prior,
    network): whoever asks for the same shares it, and an interrupted training continues from its last
    state.

    Attributes:
        problem: data and environment.
        network: what is trained.
        directory: where the policies lie.
        logs: folder of the training logs.
        run: device, compilation and logger.

    Raises:
        OSError: if ``directory`` cannot be written to.

    See Also:
        - :class:`~warmprior.experiments.Comparison`: evaluates what it holds.
        - :class:`~warmprior.training.BehaviourCloning`: trains each policy.
        - :func:`~warmprior.experiments.finished_policies`: reads them from a finished run.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.experiments import Method, navigation_problem
        >>> options, run = NetworkOptions(hidden_dim=8, observation_steps=1), RunOptions(logger="none")
        >>> method, training = Method("past", 4), TrainingConfig(iterations=4, batch_size=8, log_every=2)
        >>> with TemporaryDirectory() as folder:
        ...     store = Store(navigation_problem(), options, Path(folder), Path(folder) / "logs", run)
        ...     losses = store.train(method, training, progress=lambda iterations: None)
        ...     store.folder(method, training).name, store.load(method, training).prior.name
        ('navigation-toy-past-seed0-...', 'past')
        >>> [iteration for iteration, loss in losses]
        [2, 4]
    """

    problem: Problem
    network: NetworkOptions
    directory: Path
    logs: Path
    run: RunOptions = field(default_factory=RunOptions)
    _losses: dict[Path, Losses] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        # Workers on other machines have other working directories.
        self.directory, self.logs = self.directory.absolute(), self.logs.absolute()
        check_writable(self.directory)

    @classmethod
    def of(cls, recipe: Recipe, problem: Problem) -> Store:
        """Where the runs of a recipe keep their policies: beside the output folder, for all to share.

        Args:
            recipe: of the run.
            problem: what they are trained for.

        Raises:
            OSError: if the folder cannot be written to.
        """
        out = recipe.run.directory
        return cls(problem, recipe.network, out.parent / "policies", out / "logs", recipe.run)

    def _widths(self, method: Method) -> tuple[int, int, int]:
        """``d_a``, ``d_o`` of what the network sees, without the images, and ``To``."""
        if self.problem.images:
            check_images(method)
        action_dim = self.problem.data["action"].shape[-1]
        seen = self.problem.vector.shape[-1] + method.extra_width(action_dim)
        return action_dim, seen, self.network.observation_steps

    def new_actor(self, method: Method, training: TrainingConfig) -> WarmPriorActor:
        """A policy whose flow is untrained; its initial weights depend on the seed alone.

        What the method needs before is done: a part learns, or its teacher is trained.

        Args:
            method: what makes it differ from others.
            training: its recipe, with its seed.
        """
        problem, steps = self.problem, self.network.observation_steps
        widths = self._widths(method)
        prior, start = method.prior(widths), method.start(widths)
        for part in (prior, start):
            if isinstance(part, Learner):
                with leader_first():
                    self._learn(part, method, training)
        torch.manual_seed(training.seed)
        network = self.network.make(*widths[:2], prior.prediction_length, problem.images)
        if self.network.precondition:
            network = precondition(
                network,
                problem.data,
                prior,
                observation_steps=steps,
                coupling=self.coupling(method, training),
                withhold=method.recipe(training).cold_probability,
                rest=copy.deepcopy(problem.rest),
            )
        actor = method.actor(
            network,
            prior,
            start,
            # A copy: the policy moves to the device, the environments' normaliser stays on the CPU.
            normalizer=copy.deepcopy(problem.normalizer),
            clip=problem.clip,
            environment=problem.environment,
        )
        return actor.to(self.run.device)

    def coupling(self, method: Method, training: TrainingConfig) -> Coupling | None:
        """How a method pairs sources and targets, its teacher trained if it is not yet.

        Args:
            method: what makes it differ from others.
            training: its recipe, with its seed.
        """
        teacher = None if method.teacher is None else self.policy(method.teacher, training)
        return method.coupling(teacher)

    def _learn(self, learner: Learner, method: Method, training: TrainingConfig) -> None:
        """Let a part learn, or take what it learnt when the training was begun."""
        path = self.folder(method, training) / "learner.safetensors"
        if path.exists():
            tensors, facts = load_state(path)
            check_identity(path, facts, method.config())
            with restoring(path):
                restore_module(learner, tensors)
            return
        learn(
            learner,
            self.problem.data,
            iterations=max(1, round(LEARNING_SHARE * training.iterations)),
            observation_steps=self.network.observation_steps,
            withhold=method.recipe(training).cold_probability,
            seed=training.seed,
        )
        save_state(path, module_tensors(learner), method.config())

    def folder(self, method: Method, training: TrainingConfig) -> Path:
        """Where a policy lies, or will lie.

        Args:
            method: what makes it differ from others.
            training: its recipe, with its seed.
        """
        digest = digest_of(
            self.problem.identity,
            asdict(training),
            method.config(),
            asdict(self.network if self.problem.images else self.network.without_images()),
            self.run.device,
            self.run.compile,
            version("torch"),
            version("warmprior"),
            STATE_FORMAT,
        )
        task, style = self.problem.task, self.problem.style
        return self.directory / f"{task}-{style}-{method.name}-seed{training.seed}-{digest[:10]}"

    def train(
        self,
        method: Method,
        training: TrainingConfig,
        progress: Callable[[int], object] | None = None,
    ) -> Losses:
        """Train a policy; continue or reuse the stored one of the same options.

        On a CPU it is trained by one thread, wherever: another number would give other weights.
        Processes that have :func:`~warmprior.io.distributed.joined` train it together, each with a thread or
        a GPU of its own.

        Args:
            method: what makes it differ from others.
            training: its recipe, with its seed.
            progress: called with the number of iterations after each; a bar if ``None``.

        Returns:
            The training curve, ``[(iteration, loss), ...]``.

        Raises:
            FloatingPointError: if the loss becomes NaN or infinite.
        """
        folder = self.folder(method, training)
        if folder not in self._losses:
            if method.teacher is not None:
                self.train(method.teacher, training, progress)
            logger = None if rank() else self._logger(folder.name)
            started, known = time.process_time(), policy_path(folder, training.iterations).is_dir()
            on_cpu = torch.device(self.run.device).type == "cpu"
            with (
                torch_threads(1 if on_cpu else None),
                # A worker process ends without the exit handlers that some loggers write in.
                nullcontext() if logger is None else closing(logger),
            ):
                cloning = BehaviourCloning(
                    self.new_actor(method, training),
                    placed(self.problem.data, self.run.device),
                    method.recipe(training),
                    folder,
                    observation_steps=self.network.observation_steps,
                    coupling=self.coupling(method, training),
                    logger=logger,
                    compile=self.run.compile,
                )
                title = f"train {method.describe()}, seed {training.seed}"
                whole = cloning.iteration == 0
                cloning.run(title if progress is None else None, progress)
            used = torch.tensor(time.process_time() - started, dtype=torch.float64)
            seconds = world_size() * mean_over_processes(used).item()
            if whole and not known and not rank():
                text = json.dumps({"seconds": seconds}) + "\n"
                write_atomic(folder / TIME, lambda path: path.write_text(text))
            self.note_trained(method, training, cloning.losses)
        return self._losses[folder]

    def training_seconds(self, method: Method, training: TrainingConfig) -> float | None:
        """Processor time of a policy's training, with what learnt before it and its teacher's training.

        Args:
            method: what makes it differ from others.
            training: its recipe.

        Returns:
            ``None`` if it is not trained, or was not in one go.
        """
        path = self.folder(method, training) / TIME
        mine = read_json(path)["seconds"] if path.is_file() else None
        if mine is None or method.teacher is None:
            return mine
        teachers = self.training_seconds(method.teacher, training)
        return None if teachers is None else mine + teachers

    def note_trained(self, method: Method, training: TrainingConfig, losses: Losses) -> None:
        """Take note of a policy that another process trained.

        Args:
            method: what makes it differ from others.
            training: its recipe.
            losses: what :meth:`train` returned there.
        """
        self._losses[self.folder(method, training)] = losses

    def policy(self, method: Method, training: TrainingConfig) -> WarmPriorActor:
        """The last policy of averaged weights, trained if it is not yet, on the run's device.

        Args:
            method: what makes it differ from others.
            training: its recipe.
        """
        self.train(method, training)
        return self.load(method, training).to(self.run.device)

    def load(
        self, method: Method, training: TrainingConfig, checkpoint: int | None = None
    ) -> WarmPriorActor:
        """A trained policy of averaged weights, from disk, on the CPU.

        Args:
            method: what makes it differ from others.
            training: its recipe.
            checkpoint: iteration; the last by default.

        Raises:
            FileNotFoundError: if it is not trained that far.
        """
        path = policy_path(self.folder(method, training), checkpoint or training.iterations)
        return load_policy(path)

    def transforms(self, method: Method) -> partial[Any]:
        """Builder of the environment transforms that these policies need."""
        return partial(
            policy_transforms,
            method.prior(),
            see_history=method.sees_history,
            normalizer=self.problem.normalizer,
            **self.problem.adapters,
            observation_steps=self.network.observation_steps,
        )

    def _logger(self, name: str) -> Any:
        if self.run.logger == "none":
            return None
        return get_logger(self.run.logger, logger_name=str(self.logs), experiment_name=name)


def _facts_of(run: Path) -> dict[str, Any]:
    """What the results of a finished comparison tell about it."""
    path = run / "results.json"
    if not path.is_file():
        raise FileNotFoundError(f"--run {run}: it has no results.json; name a run of robomimic.py")
    stored = read_json(path)
    meta = stored.get("meta") if isinstance(stored, dict) else None
    if not (isinstance(meta, dict) and {"policies", "problems"} <= meta.keys()):
        raise ValueError(f"{path} does not say where its policies lie: run robomimic.py again")
    return meta


def finished_problem(run: Path) -> dict[str, Any]:
    """Facts of the (first) problem of a finished comparison.

    Args:
        run: its folder.

    Raises:
        FileNotFoundError: if there are no results.
        ValueError: if they are of something else.
    """
    return _facts_of(run)["problems"][0]


def finished_policies(
    run: Path, device: str = "cpu"
) -> tuple[dict[str, Any], dict[Method, dict[int, WarmPriorActor]]]:
    """The last policies of a finished comparison of sources.

    Args:
        run: its folder.
        device: where to put them.

    Returns:
        Facts of the problem (``task``, ``style`` and those of the data), and the policies by
        their method and training seed.

    Raises:
        FileNotFoundError: if there are no results, or a policy is missing.
        ValueError: if the results are of something else, or of several problems or recipes.

    See Also:
        - :class:`~warmprior.experiments.Store`: where a comparison keeps them.
        - :func:`~warmprior.experiments.observe`: observations to measure them on.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior.experiments import Method, Results, navigation_problem
        >>> options, run = NetworkOptions(hidden_dim=8), RunOptions(logger="none")
        >>> method, training = Method("past", 4), TrainingConfig(iterations=1, batch_size=8)
        >>> with TemporaryDirectory() as folder:  # what a Comparison does
        ...     out, policies = Path(folder) / "run", Path(folder) / "policies"
        ...     store = Store(navigation_problem(), options, policies, out / "logs", run)
        ...     _ = store.train(method, training, progress=lambda iterations: None)
        ...     kept = {"folder": store.folder(method, training).name, "iterations": 1, "seed": 0}
        ...     kept["method"] = method.config()
        ...     meta = {"policies": [kept], "problems": [{"task": "navigation", "style": "toy"}]}
        ...     Results(out / "results.json", meta, {}).save()
        ...     problem, actors = finished_policies(out)
        >>> problem["task"], next(iter(actors.values()))[0].prior.chunk_length
        ('navigation', 4)
    """
    meta = _facts_of(run)
    entries = [(Method(**entry["method"]), entry) for entry in meta["policies"]]
    compared = {(m.describe(), entry["iterations"]): (m.name, m.options) for m, entry in entries}
    if len(set(compared.values())) < len(compared) or len(meta["problems"]) > 1:
        raise ValueError(
            f"--run {run} compares {'; '.join(name for name, _ in compared)} on {len(meta['problems'])} "
            "problem(s): name a run of one task and style, with one sigma and one chunk length"
        )
    actors: dict[Method, dict[int, WarmPriorActor]] = {}
    for method, entry in entries:
        folder = policy_path(
            run.resolve().parent / "policies" / entry["folder"], entry["iterations"]
        )
        if not folder.is_dir():
            raise FileNotFoundError(
                f"{folder} is missing: finish the run with --resume --out {run}"
            )
        actors.setdefault(method, {})[entry["seed"]] = load_policy(folder, device=device)
    return meta["problems"][0], actors
