"""Any Gymnasium environment, as policies of this library are played in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import CatTensors, Compose, DoubleToFloat, GymWrapper, TransformedEnv
from torchrl.envs.gym_like import BaseInfoDictReader

from warmprior.keys import OBSERVATION


class _Infos(BaseInfoDictReader):
    """Reads numbers and flags of ``info`` as ``[1]``; what a step, or a reset, leaves out is 0."""

    def __init__(self, dtypes: Mapping[str, torch.dtype]) -> None:
        self._dtypes = dict(dtypes)

    @property
    def info_spec(self) -> Composite:
        return Composite({k: Unbounded((1,), dtype=dtype) for k, dtype in self._dtypes.items()})

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        for key, dtype in self._dtypes.items():
            value = torch.as_tensor(info_dict.get(key, 0), dtype=dtype)
            tensordict.set(key, value.reshape(1))
        return tensordict


class _Gym(GymWrapper):
    """An episode after ``set_seed(seed)`` is that of ``reset(seed=seed)``, with one reset."""

    _next: int | None = None

    def _set_seed(self, seed: int | None) -> None:
        self._next = seed

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if self._next is not None:
            kwargs["seed"], self._next = self._next, None
        return super()._reset(tensordict, **kwargs)


def gym_env(
    env: Any,
    *,
    success: str | None = None,
    measures: Sequence[str] = (),
    observation_keys: Sequence[str] = (),
) -> TransformedEnv:
    """A Gymnasium environment with ``"observation"`` ``[d_o]``, float32, and what its ``info`` says.

    Args:
        env: a Gymnasium environment whose action is one vector.
        success: name of the ``info`` that says whether the task is solved; bool ``[1]`` under the same key.
        measures: names of further numbers in ``info``, float32 ``[1]`` each.
        observation_keys: entries of a dictionary of observations, concatenated in this order; by default all.

    Raises:
        KeyError: if there is no such entry.

    Examples:
        >>> import gymnasium
        >>> from warmprior.envs import gym_env
        >>> env = gym_env(gymnasium.make("Pendulum-v1"), success="is_success")
        >>> env.reset()["observation"].shape, env.rollout(3)["next", "is_success"].any().item()
        (torch.Size([3]), False)
    """
    base = _Gym(env, categorical_action_encoding=True)
    present = [key for key in base.observation_spec.keys(True, True) if isinstance(key, str)]
    chosen = list(observation_keys) or present
    if missing := [key for key in chosen if key not in present]:
        raise KeyError(f"the environment has no observations {missing}: it has {present}")
    dtypes = {success: torch.bool} if success is not None else {}
    dtypes |= dict.fromkeys(measures, torch.float32)
    if dtypes:
        base.set_info_dict_reader(_Infos(dtypes))
    transforms = [DoubleToFloat()]
    if chosen != [OBSERVATION]:
        transforms.append(CatTensors(chosen, OBSERVATION, sort=False))
    return TransformedEnv(base, Compose(*transforms))
