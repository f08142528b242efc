"""Behaviour cloning: the training loop, resumable at any moment with the same result."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.record.loggers.common import Logger
from tqdm import tqdm

from warmprior.checks import check_finite
from warmprior.io.distributed import check_batch, from_leader, rank, wait_for_leader, world_size
from warmprior.io.files import check_writable, exclusive, storing
from warmprior.io.progress import progress_bar
from warmprior.keys import ACTION, EPISODE, OBSERVATION
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import device_of, uncompiled
from warmprior.objectives.couplings import Coupling
from warmprior.options.training import TrainingConfig
from warmprior.saving.policies import check_saveable, load_policy, policy_config, save_policy
from warmprior.saving.training_state import (
    RunState,
    differences,
    fixed_identity,
    named,
    restore_rng,
    rng_tensors,
    run_identity,
    select,
)
from warmprior.training.gradient_step import GradientStep
from warmprior.training.placement import Prefetch
from warmprior.transforms.window import window_replay_buffer

WINDOWS_SEED = 1_000_003
"""An offset of the seed of a separate window generator, so that it does not repeat the source's draws."""


class BehaviourCloning:
    """A run that trains a :class:`~warmprior.WarmPriorActor` on demonstrations by flow matching.

    The folder receives ``state.safetensors`` (all that is needed to continue) and a policy with averaged
    weights per checkpoint, ``policy_000250/`` and so on. Starting the run again on the same
    folder continues it; on a CPU the result is bitwise equal to that of an uninterrupted run with the same
    number of threads.

    Processes in :func:`~warmprior.io.distributed.joined` train together: each constructs and executes
    the same run and draws its own part of every batch, PyTorch's DDP averages the gradients, and only the
    first process writes.

    Args:
        actor: the policy; its network, and its prior if it has weights, are trained in place.
        data: contiguous normalised steps, see :class:`~warmprior.ActionWindow`; on the network's device,
            or on the CPU if they do not fit there.
        config: the recipe.
        directory: the folder.

    Keyword Args:
        coupling: pairs sources and targets, see :class:`~warmprior.FlowMatchingLoss`.
        logger: a TorchRL logger for the loss, the learning rate and the speed.
        compile: True compiles the velocity network with :func:`torch.compile`; on a GPU, with CUDA graphs.
        prefetch: True prefetches batches, drawn by a separate generator, in a thread. This is always done
            if the data are on the CPU and the network is not.

    Raises:
        ValueError: if a batch cannot be divided among the processes, the state is damaged or belongs to
            another run, the policy could not be reloaded once saved, its start point is not frozen, or the
            network cannot be compiled.
        TypeError: if the policy cannot be saved.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.envs import navigation_demonstrations
        >>> from warmprior.training import BehaviourCloning, TrainingConfig
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1, hidden_dim=8), PastPrior(4))
        >>> config = TrainingConfig(iterations=2, batch_size=8, checkpoints=1)
        >>> data = navigation_demonstrations()
        >>> with TemporaryDirectory() as folder:
        ...     BehaviourCloning(actor, data, config, folder).run()
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['policy_000002', 'state.safetensors']
    """

    def __init__(
        self,
        actor: WarmPriorActor,
        data: TensorDictBase,
        config: TrainingConfig,
        directory: str | Path,
        *,
        coupling: Coupling | None = None,
        logger: Logger | None = None,
        compile: bool = False,
        prefetch: bool = False,
    ) -> None:
        check_saveable(actor)  # before the training, whose result would be lost
        check_batch(config.batch_size)
        if actor.start is not None and any(p.requires_grad for p in actor.start.parameters()):
            raise ValueError(f"train {type(actor.start).__name__} before the flow, and freeze it")
        self.actor = actor
        self.config = config
        self.directory = Path(directory)
        self.logger = logger
        self.rank = rank()
        home = data.device or torch.device("cpu")
        device = device_of(actor.network, data)
        self.generator = torch.Generator(device).manual_seed(config.seed)
        windows = self.generator
        prefetch = prefetch or home.type != device.type
        if prefetch:  # a shared generator would be ahead of the losses by the prefetched draws
            windows = torch.Generator(home).manual_seed(WINDOWS_SEED + config.seed)
        see_history = actor.sees_history  # then windows extend the data's observation
        observation_key = OBSERVATION if see_history else actor.observation_key
        self.replay_buffer = window_replay_buffer(
            data,
            actor.prior,
            batch_size=config.batch_size // world_size(),
            observation_steps=uncompiled(actor.network).observation_steps,
            see_history=see_history,
            withhold=config.cold_probability,
            generator=windows,
            observation_key=observation_key,
        )
        self._prefetch = Prefetch(self.replay_buffer.sample, windows, device=device) if prefetch else None
        self.update = GradientStep(actor, config, coupling=coupling, generator=self.generator)
        self.iteration = 0
        self.losses: list[tuple[int, float]] = []
        self._running: list[torch.Tensor] = []  # losses since the last logged mean
        self.identity = run_identity(
            data.select(observation_key, ACTION, EPISODE),
            asdict(config) | {"weighting": self.update.loss_module.weighting},
            prior=actor.prior,
            start=actor.start,
            coupling=coupling,
            network=actor.network,
            policy={
                "clip": actor.sampling.clip,
                "max_nfe": actor.sampling.max_nfe,
                "normalizer": fixed_identity(actor.normalizer),  # data in other units may be equal
            },
            device=self.generator.device.type,  # a generator's state is of one kind of device
        )
        torch.manual_seed(config.seed)
        self._differ()
        self._state = RunState(self.directory, self.identity)
        #: The path of the training state.
        self.state_path = self._state.path
        self._state.restore(self._load)
        self._compiles = compile
        if compile:
            self.update.compile()

    def policy_path(self, iteration: int | None = None) -> Path:
        """Return the path of the policy kept after ``iteration``, by default the last one."""
        return policy_path(self.directory, self.config.iterations if iteration is None else iteration)

    def step(self) -> torch.Tensor:
        """Take a gradient step; return the loss of this process's part of the batch, a detached scalar."""
        loss = self.update(self._prefetch() if self._prefetch else self.replay_buffer.sample())
        self.iteration += 1
        return loss

    def run(self, description: str | None = "train", progress: Callable[[int], object] | None = None) -> None:
        """Train to the end; ``progress`` gets the number of iterations, at the start and after each.

        Without a ``description`` there is no progress bar.

        Raises:
            FloatingPointError: if the loss becomes NaN or infinite; the last state and all policies are kept.
            BlockingIOError: if another process is training in the folder.
            OSError: if the folder cannot be written to.
        """
        if from_leader(lambda: self.iteration == self.config.iterations and self._changes() == ""):
            return
        from_leader(lambda: check_writable(self.directory))
        with exclusive(self.directory) if not self.rank else nullcontext():
            wait_for_leader()  # until it has locked the folder
            self._state.restore(self._load)  # another process may have trained since this object was built
            if from_leader(lambda: self.iteration) != self.iteration:
                raise OSError(f"processes read different states at {self.state_path}: share the directory")
            try:
                self._run(description, progress)
            finally:
                if self._prefetch is not None:
                    self._prefetch.close()

    def _run(self, description: str | None, progress: Callable[[int], object] | None) -> None:
        config = self.config
        keep = set(config.checkpoint_iterations)
        if self.iteration in keep and not self.rank and (changes := self._changes()) != "":
            self._keep()
            if changes and description is not None:
                place = self.policy_path(self.iteration)
                tqdm.write(f"{place} was trained before; its weights stay ({changes})", file=sys.stderr)
        save_every = config.save_every or max(1, config.iterations // config.checkpoints // 10)
        self.actor.train()
        bar = progress_bar(
            description, total=config.iterations, initial=self.iteration, unit="it", dynamic_ncols=True
        )
        self._logged = self.iteration, time.monotonic()
        report = progress or (lambda iteration: None)
        report(self.iteration)
        with bar:
            if self._compiles and self.iteration < config.iterations:
                bar.set_postfix_str("compiling the network")
            while (i := self.iteration + 1) <= config.iterations:
                self._running.append(self.step())
                bar.update()
                report(i)
                logs = i % config.log_every == 0 or i == config.iterations
                saves = i in keep or i % save_every == 0
                if logs or saves:
                    self._check_finite()
                if logs:
                    self._log(torch.stack(self._running).mean().item(), bar)
                    self._running.clear()
                if i in keep and not self.rank:
                    self._keep()
                if saves and not self.rank:
                    self._save()

    def _keep(self) -> None:
        """Keep the policy of this iteration."""
        save_policy(self.update.averaged(self.actor), self.policy_path(self.iteration))

    def _changes(self) -> str | None:
        """Return how this run's policy acts otherwise than that on disk; ``None`` if none is complete."""
        try:
            with torch.random.fork_rng([]):  # loading a policy first draws random weights
                kept = policy_config(load_policy(self.policy_path(self.iteration)))
        except (OSError, ValueError):
            return None
        parts = ("actor", "environment")
        before, now = ({part: each[part] for part in parts} for each in (kept, policy_config(self.actor)))
        return differences(before, now)

    def _check_finite(self) -> None:
        # Checked before every save, and not only before logs: a run cannot resume from a saved NaN.
        saved = f"; the last good state is {self.state_path}" if self.state_path.exists() else ""
        check_finite(
            {"the loss": torch.stack(self._running), **dict(self.update.trained.named_parameters())},
            f"at or before iteration {self.iteration}{saved}. Lower the learning rate or check the data",
        )

    def _log(self, loss: float, bar: Any) -> None:
        self.losses.append((self.iteration, loss))
        bar.set_postfix(loss=f"{loss:.4f}", refresh=False)
        if self.logger is not None and not self.rank:
            iteration, moment = self._logged
            self._logged = self.iteration, time.monotonic()
            values = {
                "train/loss": loss,
                "train/learning_rate": self.update.schedule.get_last_lr()[0],
                "train/iterations_per_second": (self.iteration - iteration) / (self._logged[1] - moment),
            }
            place = Path(getattr(self.logger, "log_dir", None) or ".")  # Weights & Biases may have none
            with storing(f"cannot write the log to {place}", place):  # a full disk's error names no file
                for name, value in values.items():
                    self.logger.log_scalar(name, value, step=self.iteration)

    def _save(self) -> None:
        tensors = {
            **self.update.state(),
            **named("rng", rng_tensors(self.generator)),
            **({} if self._prefetch is None else {"rng/windows": self._prefetch.state()}),
            "running": torch.stack(self._running) if self._running else torch.empty(0),
        }
        self._state.save(tensors, iteration=self.iteration, losses=self.losses)

    def _differ(self) -> None:
        """Draw windows, sources, times, dropout and crops that differ from the other processes'."""
        if not self.rank:
            return
        torch.manual_seed(int(torch.randint(2**62, ())) + self.rank)
        self.generator.manual_seed(int(torch.randint(2**62, ())))
        if self._prefetch is not None:
            self._prefetch.restore(int(torch.randint(2**62, ())))

    def _load(self, tensors: dict[str, torch.Tensor], facts: dict[str, Any]) -> None:
        self.iteration = facts["iteration"]
        self.losses = [(i, float(loss)) for i, loss in facts["losses"]]
        self.update.load(tensors, self.iteration)
        self._running = list(tensors["running"].to(self.generator.device))
        restore_rng(self.generator, select("rng", tensors))
        if self._prefetch is not None:
            # The state has no window generator if the data were on the device: there one generator draws all.
            seed = WINDOWS_SEED + self.config.seed + self.iteration
            self._prefetch.restore(tensors.get("rng/windows", seed))
        self._differ()


def policy_path(directory: Path, iteration: int) -> Path:
    """Return the folder of the policy that a run in ``directory`` keeps after an iteration."""
    return directory / f"policy_{iteration:06d}"
