"""The reward of a task that is either solved or not."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from torchrl.envs.transforms import Compose

from warmprior import keys
from warmprior.checks import check_keys
from warmprior.transforms.inner_step import EnvTransform


class SuccessReward(EnvTransform):
    """A transform that rewards a step with 1 if the task is solved then, and with 0 otherwise.

    It replaces the environment's own reward. Place it before :class:`ChunkStep`, so that it sees every
    control step.

    Raises:
        KeyError: (at a step) if the environment writes no ``"success"``.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior.envs import NavigationEnv
        >>> from warmprior.transforms import SuccessReward
        >>> after = TransformedEnv(NavigationEnv(), SuccessReward()).rollout(3)["next"]
        >>> bool((after["reward"] == after["success"].float()).all())
        True
    """

    def __init__(self) -> None:
        super().__init__(in_keys=[keys.SUCCESS], out_keys=["reward"])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        check_keys(next_tensordict, self.in_keys, "SuccessReward")
        reward = next_tensordict["reward"]
        return next_tensordict.set("reward", next_tensordict[keys.SUCCESS].view_as(reward).to(reward.dtype))


def rewarded_by_success(make_transforms: Callable[[], Compose]) -> Compose:
    """Return transforms that begin with :class:`SuccessReward`."""
    transforms = make_transforms()
    transforms.insert(0, SuccessReward())
    return transforms
