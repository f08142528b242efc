"""Trained policies on disk, found again by everything that determines them."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchrl.record.loggers import get_logger

from warmprior.experiments.problem import Problem
from warmprior.experiments.recipe import NetworkOptions, Recipe, RunOptions, check_images
from warmprior.io.distributed import leader_first, mean_over_processes, rank, world_size
from warmprior.io.files import check_writable, digest_of, read_json, write_atomic
from warmprior.io.options import identity_of
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.learned import LearnedPrior
from warmprior.modules.prior import Prior
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
from warmprior.training.prior_learning import learn_prior
from warmprior.training.threads import torch_threads
from warmprior.training.training_config import TrainingConfig
from warmprior.transforms import MeanObservation, policy_transforms

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
        >>> from warmprior import PastPrior
        >>> from warmprior.experiments import navigation_problem
        >>> options, run = NetworkOptions(hidden_dim=8, observation_steps=1), RunOptions(logger="none")
        >>> prior, training = PastPrior(4), TrainingConfig(iterations=4, batch_size=8, log_every=2)
        >>> with TemporaryDirectory() as folder:
        ...     store = Store(navigation_problem(), options, Path(folder), Path(folder) / "logs", run)
        ...     losses = store.train(prior, training, progress=lambda iterations: None)
        ...     store.folder(prior, training).name, store.load(prior, training).prior.name
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

    def sized(self, prior: Prior) -> Prior:
        """A prior for the widths of this problem, see :meth:`Prior.sized`.

        Raises:
            ValueError: if it reads observation vectors, and the problem's have images.
        """
        if self.problem.images:
            check_images(prior)
        return prior.sized(*self._widths(prior), self.network.observation_steps)

    def _widths(self, prior: Prior) -> tuple[int, int]:
        """``d_a``, and ``d_o`` of what the network sees; without the images."""
        action_dim = self.problem.data["action"].shape[-1]
        width = self.problem.vector.shape[-1]
        return action_dim, width + MeanObservation.width(prior, action_dim)

    def new_actor(self, prior: Prior, training: TrainingConfig) -> WarmPriorActor:
        """A policy whose flow is untrained; its initial weights depend on the seed alone.

        What the prior needs before is done: it learns, or its teacher is trained.

        Args:
            prior: its source distribution.
            training: its recipe, with its seed.
        """
        prior, problem = self._prepared(self.sized(prior), training), self.problem
        torch.manual_seed(training.seed)
        network = self.network.make(*self._widths(prior), prior.prediction_length, problem.images)
        if self.network.precondition:
            steps = self.network.observation_steps
            network = precondition(
                network,
                problem.data,
                prior,
                observation_steps=steps,
                rest=copy.deepcopy(problem.rest),
            )
        actor = WarmPriorActor(
            network,
            prior,
            # A copy: the policy moves to the device, the environments' normaliser stays on the CPU.
            normalizer=copy.deepcopy(problem.normalizer),
            clip=problem.clip,
            environment=problem.environment,
        )
        return actor.to(self.run.device)

    def _prepared(self, prior: Prior, training: TrainingConfig) -> Prior:
        if isinstance(prior, nn.Module):  # it learns: every policy has its own
            prior = Prior.from_config(prior.config())
        if isinstance(prior, LearnedPrior):
            with leader_first():
                self._learn(prior, training)
        if prior.teacher is not None:
            prior = prior if isinstance(prior, nn.Module) else copy.copy(prior)
            prior.learn_from(self.policy(self.teacher(prior), training))
        return prior

    def teacher(self, prior: Prior) -> Prior:
        """The prior whose policy teaches another one, see :attr:`Prior.teacher`."""
        assert prior.teacher is not None
        return Prior.make(prior.teacher, prior.chunk_length)

    def _learn(self, prior: LearnedPrior, training: TrainingConfig) -> None:
        """Let a prior learn, or take what it learnt when the training was begun."""
        path = self.folder(prior, training) / "prior.safetensors"
        if path.exists():
            tensors, facts = load_state(path)
            check_identity(path, facts, prior.config())
            with restoring(path):
                restore_module(prior, tensors)
            return
        learn_prior(
            prior,
            self.problem.data,
            iterations=max(1, round(LEARNING_SHARE * training.iterations)),
            observation_steps=self.network.observation_steps,
            seed=training.seed,
        )
        save_state(path, module_tensors(prior), prior.config())

    def folder(self, prior: Prior, training: TrainingConfig) -> Path:
        """Where a policy lies, or will lie.

        Args:
            prior: its source distribution.
            training: its recipe, with its seed.
        """
        digest = digest_of(
            self.problem.identity,
            identity_of(training),
            self.sized(prior).config(),
            identity_of(self.network if self.problem.images else self.network.without_images()),
            self.run.device,
            self.run.compile,
            version("torch"),
            version("warmprior"),
            STATE_FORMAT,
        )
        task, style = self.problem.task, self.problem.style
        return self.directory / f"{task}-{style}-{prior.name}-seed{training.seed}-{digest[:10]}"

    def train(
        self,
        prior: Prior,
        training: TrainingConfig,
        progress: Callable[[int], object] | None = None,
    ) -> Losses:
        """Train a policy; continue or reuse the stored one of the same options.

        On a CPU it is trained by one thread, wherever: another number would give other weights.
        Processes that have :func:`~warmprior.io.distributed.joined` train it together, each with a thread or
        a GPU of its own.

        Args:
            prior: its source distribution.
            training: its recipe, with its seed.
            progress: called with the number of iterations after each; a bar if ``None``.

        Returns:
            The training curve, ``[(iteration, loss), ...]``.

        Raises:
            FloatingPointError: if the loss becomes NaN or infinite.
        """
        folder = self.folder(prior, training)
        if folder not in self._losses:
            if prior.teacher is not None:
                self.train(self.teacher(prior), training, progress)
            logger = None if rank() else self._logger(folder.name)
            started, known = time.process_time(), policy_path(folder, training.iterations).is_dir()
            on_cpu = torch.device(self.run.device).type == "cpu"
            with (
                torch_threads(1 if on_cpu else None),
                # A worker process ends without the exit handlers that some loggers write in.
                nullcontext() if logger is None else closing(logger),
            ):
                cloning = BehaviourCloning(
                    self.new_actor(prior, training),
                    placed(self.problem.data, self.run.device),
                    training,
                    folder,
                    observation_steps=self.network.observation_steps,
                    logger=logger,
                    compile=self.run.compile,
                )
                told = f"train {prior.describe()}, seed {training.seed}"
                whole = cloning.iteration == 0
                cloning.run(told if progress is None else None, progress)
            used = torch.tensor(time.process_time() - started, dtype=torch.float64)
            seconds = world_size() * mean_over_processes(used).item()
            if whole and not known and not rank():
                text = json.dumps({"seconds": seconds}) + "\n"
                write_atomic(folder / TIME, lambda path: path.write_text(text))
            self.note_trained(prior, training, cloning.losses)
        return self._losses[folder]

    def training_seconds(self, prior: Prior, training: TrainingConfig) -> float | None:
        """Processor time of a policy's training, with what its prior learnt and its teacher's training.

        Args:
            prior: its source distribution.
            training: its recipe.

        Returns:
            ``None`` if it is not trained, or was not in one go.
        """
        path = self.folder(prior, training) / TIME
        mine = read_json(path)["seconds"] if path.is_file() else None
        if mine is None or prior.teacher is None:
            return mine
        teachers = self.training_seconds(self.teacher(prior), training)
        return None if teachers is None else mine + teachers

    def note_trained(self, prior: Prior, training: TrainingConfig, losses: Losses) -> None:
        """Take note of a policy that another process trained.

        Args:
            prior: its source distribution.
            training: its recipe.
            losses: what :meth:`train` returned there.
        """
        self._losses[self.folder(prior, training)] = losses

    def policy(self, prior: Prior, training: TrainingConfig) -> WarmPriorActor:
        """The last policy of averaged weights, trained if it is not yet, on the run's device.

        Args:
            prior: its source distribution.
            training: its recipe.
        """
        self.train(prior, training)
        return self.load(prior, training).to(self.run.device)

    def load(
        self, prior: Prior, training: TrainingConfig, checkpoint: int | None = None
    ) -> WarmPriorActor:
        """A trained policy of averaged weights, from disk, on the CPU.

        Args:
            prior: its source distribution.
            training: its recipe.
            checkpoint: iteration; the last by default.

        Raises:
            FileNotFoundError: if it is not trained that far.
        """
        path = policy_path(self.folder(prior, training), checkpoint or training.iterations)
        return WarmPriorActor.from_pretrained(path, prior=self.sized(prior))

    def transforms(self, prior: Prior) -> partial[Any]:
        """Builder of the environment transforms that these policies need."""
        return partial(
            policy_transforms,
            prior,
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
) -> tuple[dict[str, Any], dict[tuple[str, str], dict[int, WarmPriorActor]]]:
    """The last policies of a finished comparison of sources.

    Args:
        run: its folder.
        device: where to put them.

    Returns:
        Facts of the problem (``task``, ``style`` and those of the data), and the policies by name and
        :attr:`~warmprior.Prior.options` of their prior and training seed.

    Raises:
        FileNotFoundError: if there are no results, or a policy is missing.
        ValueError: if the results are of something else, or of several problems or recipes.

    See Also:
        - :class:`~warmprior.experiments.Store`: where a comparison keeps them.
        - :func:`~warmprior.experiments.observe`: observations to measure them on.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior import PastPrior
        >>> from warmprior.experiments import Results, navigation_problem
        >>> options, run = NetworkOptions(hidden_dim=8), RunOptions(logger="none")
        >>> prior, training = PastPrior(4), TrainingConfig(iterations=1, batch_size=8)
        >>> with TemporaryDirectory() as folder:  # what a Comparison does
        ...     out, policies = Path(folder) / "run", Path(folder) / "policies"
        ...     store = Store(navigation_problem(), options, policies, out / "logs", run)
        ...     _ = store.train(prior, training, progress=lambda iterations: None)
        ...     kept = {"folder": store.folder(prior, training).name, "iterations": 1, "seed": 0}
        ...     kept["prior"] = prior.config()
        ...     meta = {"policies": [kept], "problems": [{"task": "navigation", "style": "toy"}]}
        ...     Results(out / "results.json", meta, {}).save()
        ...     problem, actors = finished_policies(out)
        >>> problem["task"], actors["past", ""][0].prior.chunk_length
        ('navigation', 4)
    """
    meta = _facts_of(run)
    entries = [(Prior.from_config(entry["prior"]), entry) for entry in meta["policies"]]
    told = {
        (prior.describe(), entry["iterations"]): (prior.name, prior.options)
        for prior, entry in entries
    }
    if len(set(told.values())) < len(told) or len(meta["problems"]) > 1:
        raise ValueError(
            f"--run {run} compares {'; '.join(name for name, _ in told)} on {len(meta['problems'])} "
            "problem(s): name a run of one task and style, with one sigma and one chunk length"
        )
    actors: dict[tuple[str, str], dict[int, WarmPriorActor]] = {}
    for prior, entry in entries:
        folder = policy_path(
            run.resolve().parent / "policies" / entry["folder"], entry["iterations"]
        )
        if not folder.is_dir():
            raise FileNotFoundError(
                f"{folder} is missing: finish the run with --resume --out {run}"
            )
        actor = WarmPriorActor.from_pretrained(folder, prior=prior, device=device)
        actors.setdefault((prior.name, prior.options), {})[entry["seed"]] = actor
    return meta["problems"][0], actors
