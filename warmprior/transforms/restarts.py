"""Resets of rows whose episode has ended while other rows go on with their chunk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tensordict import TensorDict, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.libs.gym import GymWrapper
from torchrl.envs.transforms import (
    AutoResetTransform,
    Compose,
    Transform,
    TransformedEnv,
    VecGymEnvTransform,
)

NATIVE = "_torchrl_native_autoreset"
"""TorchRL's name of environments whose steps return the next episode's first observation at an end."""


class Restarts:
    """The restarts of rows whose episode has ended, while the other rows of a batch go on.

    Most environments leave these rows idle, or step them without effect, until TorchRL resets them. Some
    restart these rows by themselves, and would execute the rest of a chunk in the next episode.

    Args:
        container: the environment that steps and resets.
        transforms: the transforms that belong to a step.

    Attributes:
        native: True if the simulator restarts rows, and resets single ones on request (Isaac Lab, mjlab):
            such rows get a fresh reset after the last step of a decision.
        needed: True if the simulator refuses to step rows that have ended (Gymnasium's
            ``AutoresetMode.DISABLED``): such rows get a reset before every further step.
    """

    def __init__(self, container: TransformedEnv, transforms: Sequence[Transform]) -> None:
        self._base: EnvBase = container.base_env
        simulator, below = self._base, list(transforms)
        while isinstance(simulator, TransformedEnv):
            below += flat(simulator.transform)
            simulator = simulator.base_env
        mode = getattr(simulator, "autoreset_mode", None) if isinstance(simulator, GymWrapper) else None
        self._mode = getattr(mode, "name", None)
        several = simulator.numel() > 1
        self.native = several and bool(container.__dict__.get(NATIVE, False))
        self.needed = several and self._mode == "DISABLED"
        alone = any(isinstance(t, AutoResetTransform | VecGymEnvTransform) for t in below)
        self._alone = several and alone and not self.native
        self._whole_workers = isinstance(simulator, BatchedEnvBase) and simulator.batch_size[1:].numel() > 1

    def check(self, execute: int) -> None:
        """Raise RuntimeError if chunks of ``execute`` actions would go on in the next episode."""
        vector = "build the vector environment with autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED"
        if self._mode == "NEXT_STEP":
            raise RuntimeError(
                f"Gymnasium's AutoresetMode.NEXT_STEP ignores the first action of every episode: {vector}, "
                "and give it to GymWrapper"
            )
        if self._whole_workers and execute > 1:
            raise RuntimeError(
                "every worker has several rows, and TorchRL steps them together, also where an episode has "
                "ended inside a chunk: append the transforms to the environments inside the workers, or use "
                f"execute=1, not {execute}"
            )
        if self._alone and execute > 1:
            raise RuntimeError(
                "this environment restarts a row in the step that ends its episode, so the rest of a chunk "
                f"would be executed in the next one: use execute=1, not {execute}, or an environment that "
                f"TorchRL resets (SerialEnv, ParallelEnv; for Gymnasium: {vector})"
            )

    def rows(self, ended: Tensor) -> TensorDictBase:
        """Reset the rows in ``ended``, bool ``[*B]``; the result is defined in them alone."""
        spec, masks = self._base.full_done_spec, TensorDict({}, ended.shape, device=self._base.device)
        for key in self._base.reset_keys:
            like = spec[(*key[:-1], "done") if isinstance(key, tuple) else "done"].zero()
            masks.set(key, expand_as_right(ended, like).clone())
        try:
            return self._base._reset(masks)
        except Exception as error:
            raise RuntimeError(
                f"{type(self._base).__name__} restarts rows by itself and cannot reset them: use execute=1, "
                "so that every decision ends where an episode does"
            ) from error


def flat(transform: Transform) -> Iterator[Transform]:
    """Yield a transform, or all that it is composed of, in their order."""
    if isinstance(transform, Compose):
        for part in transform:
            yield from flat(part)
    else:
        yield transform
