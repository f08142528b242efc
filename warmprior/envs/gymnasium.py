"""Gymnasium environments with the keys that policies of this library need."""

from __future__ import annotations

import copy
import importlib
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any

import cloudpickle
import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import (
    CatTensors,
    Compose,
    DoubleToFloat,
    DTypeCastTransform,
    GymWrapper,
    TransformedEnv,
)
from torchrl.envs.gym_like import BaseInfoDictReader

from warmprior.checks import check_distinct, given, is_true
from warmprior.envs.rendering import rendering_backend
from warmprior.keys import OBSERVATION, SUCCESS


class _Infos(BaseInfoDictReader):
    """A reader of entries of ``info`` as ``[1]``: measures, and a flag that becomes ``"success"``.

    Entries missing after a step or reset are 0.
    """

    def __init__(self, success: str | None, measures: Sequence[str]) -> None:
        self.success, self._measures = success, list(measures)
        self.names: set[str] = set()
        """The names in the last ``info``."""

    @property
    def info_spec(self) -> Composite:
        numbers = {name: Unbounded((1,), dtype=torch.float32) for name in self._measures}
        flag = {} if self.success is None else {SUCCESS: Unbounded((1,), dtype=torch.bool)}
        return Composite(numbers | flag)

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        self.names = set(info_dict)
        for name in self._measures:
            value = torch.as_tensor(info_dict.get(name, 0), dtype=torch.float32)
            tensordict.set(name, value.reshape(1))
        if self.success is not None:
            solved = is_true(self.success, info_dict.get(self.success, 0))
            tensordict.set(SUCCESS, torch.tensor([solved]))
        return tensordict


class _Gym(GymWrapper):
    """A wrapper whose episode after ``set_seed(seed)`` is that of a single ``reset(seed=seed)``."""

    _seed: int | None = None
    ends_at_success = False
    infos: _Infos | None = None
    step_names: set[str] | None = None
    """The names in ``info`` after steps of the first episode, while success is not among them."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        result = super()._step(tensordict)
        if self.ends_at_success and result[SUCCESS].any():
            for flag in ("terminated", "done"):
                result.set(flag, torch.ones_like(result[flag]))
        if self.infos is not None and self.step_names is not None:
            names, success = self.step_names | self.infos.names, self.infos.success
            ended, found = bool(result["done"].any()), success in names
            self.step_names = None if ended or found else names
            if ended and not found:
                warnings.warn(
                    f"info had no {success!r} in a whole episode, so it counts as not solved; it had "
                    f"{sorted(names)}: choose the entry that is True once the task is solved",
                    stacklevel=2,
                )
        return result

    def read_obs(self, observations: Any) -> dict[str, Any]:
        # An environment may write all its observations into one buffer.
        return super().read_obs(copy.deepcopy(observations))

    def set_info_dict_reader(self, info_dict_reader: Any = None, **options: Any) -> Any:
        # A reader writes over what a step returned, without a word.
        returned = {OBSERVATION, *self.observation_spec.keys(), *self.reward_keys, *self.done_keys}
        super().set_info_dict_reader(info_dict_reader, **options)
        written = getattr(self.info_dict_reader[-1], "info_spec", {})  # a function may read as well
        if hidden := sorted(returned & set(written.keys())):
            raise ValueError(
                f"the entries {hidden} of info would replace the environment's own: rename them in info, or "
                "leave them out of measures (success is written under 'success')"
            )
        return self

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if self._seed is not None:
            kwargs["seed"], self._seed = self._seed, None
        return super()._reset(tensordict, **kwargs)


def gym_env(
    env: Any,
    *,
    success: str | None = None,
    measures: Sequence[str] = (),
    observation_keys: Sequence[str] = (),
    terminate_on_success: bool = False,
) -> TransformedEnv:
    """Wrap a Gymnasium environment, with ``"observation"`` ``[d_o]``, float32, and entries of its ``info``.

    Args:
        env: a Gymnasium environment whose action is one vector.
        success: name of the entry of ``info`` that is True once the task is solved; written under
            ``"success"`` as bool ``[1]``, False where ``info`` lacks it. A warning says if a whole episode
            does.
        measures: names of further numbers in ``info``, written as float32 ``[1]``, 0 where it lacks them.
        observation_keys: entries of a dictionary of observations, concatenated in this order, with
            ``"outer/inner"`` in nested ones; by default all.
        terminate_on_success: True ends the episode once the task is solved.

    Raises:
        KeyError: if the environment lacks one of ``observation_keys``.
        ValueError: if an observation is not a vector, such as a discrete one, entries of ``info`` would
            replace others or are asked of a vector environment, or (at a step) success is a fraction.

    Examples:
        >>> import gymnasium
        >>> from warmprior.envs import gym_env
        >>> env = gym_env(gymnasium.make("Pendulum-v1"), success="is_success")
        >>> env.reset()["observation"].shape, env.rollout(3)["next", "success"].any().item()
        (torch.Size([3]), False)
    """
    base = _Gym(env, categorical_action_encoding=True)
    # TorchRL reads all entries of info of vector environments that restart rows.
    in_info = {key for reader in base.info_dict_reader for key in reader.info_spec.keys(True, True)}
    seen = [key for key in base.observation_spec.keys(True, True) if key not in in_info]
    present = {key if isinstance(key, str) else "/".join(key): key for key in seen}
    chosen = list(observation_keys) or list(present)
    check_distinct("observation_keys", chosen)
    if missing := [key for key in chosen if key not in present]:
        raise KeyError(f"the environment has no observations {missing}: it has {list(present)}")
    entries = [*measures, *([] if success is None else [success])]
    if entries:
        check_distinct("measures", [*measures, *([] if success is None else [SUCCESS])])
    if entries and base.batch_size:
        raise ValueError(
            f"entries of info ({', '.join(entries)}) are read from single environments: give torchrl's "
            "ParallelEnv one per worker, in place of a vector environment"
        )
    if entries:
        base.infos, base.step_names = _Infos(success, measures), None if success is None else set()
        base.set_info_dict_reader(base.infos)
    base.ends_at_success = terminate_on_success and success is not None
    specs = {key: base.observation_spec[present[key]] for key in chosen}
    ndims = {key: spec.ndim - len(base.batch_size) for key, spec in specs.items()}
    if others := [key for key, ndim in ndims.items() if ndim < 1 or (ndim > 1 and len(specs) > 1)]:
        raise ValueError(
            f"the observations {others} are no vectors: leave them out of observation_keys, or wrap the "
            "environment in gymnasium.wrappers.FlattenObservation"
        )
    floats = torch.float32, torch.float64
    transforms = [DoubleToFloat()]
    for key, spec in specs.items():
        if ndims[key] == 1 and spec.dtype not in floats:
            transforms.append(DTypeCastTransform(spec.dtype, torch.float32, in_keys=[present[key]]))
    if chosen != [OBSERVATION]:
        transforms.append(CatTensors([present[key] for key in chosen], OBSERVATION, sort=False))
    return TransformedEnv(base, Compose(*transforms))


REGISTERING = ("gymnasium_robotics", "gym_pusht")
"""The packages that register environments when imported; they are imported if installed."""


def registered_env(
    description: Mapping[str, Any],
    *,
    terminate_on_success: bool = True,
    horizon: int | None = None,
    render_mode: str | None = None,
    entry: Any = None,
) -> TransformedEnv:
    """Build an environment of Gymnasium's registry from a description in data or a policy.

    Nothing that a description names is imported: a package in :data:`REGISTERING`, or one that you import
    before, must register the environment.

    Args:
        description: ``"id"`` and ``"kwargs"`` of ``gymnasium.make``, ``"max_episode_steps"``, and
            ``"success"`` and ``"observation_keys"`` of :func:`gym_env`; in data also the ``"dataset"``, for
            errors.
        terminate_on_success: see :func:`gym_env`.
        horizon: time limit in control steps, instead of ``"max_episode_steps"``.
        render_mode: see ``gymnasium.make``; ``"rgb_array"`` for pictures.
        entry: the ``EnvSpec`` to build; by default the one that is registered under the name.

    Raises:
        ImportError: if no environment with this name is registered.
        ValueError: if the description has wrappers, which would be imported, or the environment cannot be
            built as it says.

    Examples:
        >>> from warmprior.envs import registered_env
        >>> env = registered_env({"id": "Pendulum-v1", "max_episode_steps": 3})
        >>> env.rollout(9)["next", "truncated"].flatten().tolist()
        [False, False, True]
    """
    gymnasium = importlib.import_module("gymnasium")
    name, wrappers = description["id"], description.get("wrappers")
    for package in REGISTERING if name not in gymnasium.registry else ():
        if find_spec(package) is not None:
            importlib.import_module(package)
    if entry is None and name not in gymnasium.registry:
        raise ImportError(
            f"Gymnasium has no environment {name!r}: install the package that registers it, and import that "
            "before (gymnasium-robotics: pip install --no-deps gymnasium-robotics pettingzoo imageio)"
        )
    if wrappers:
        raise ValueError(
            f"{name} was recorded with the wrappers {wrappers}: build it yourself, with make_env"
        )
    if render_mode is not None and (backend := rendering_backend()) is not None:
        os.environ["MUJOCO_GL"] = backend  # environments of MuJoCo would first try to open a window
    kwargs, rendered = description.get("kwargs") or {}, given(render_mode=render_mode)
    try:
        env = gymnasium.make(
            name if entry is None else entry,
            max_episode_steps=description.get("max_episode_steps") if horizon is None else horizon,
            **{key: value for key, value in kwargs.items() if key != "render_mode"} | rendered,
        )
    except ImportError:
        raise
    except Exception as error:  # the environment's own, of any class
        raise ValueError(
            f"{description.get('dataset', 'the policy')} was recorded in {name} with kwargs={kwargs}, which "
            f"is not built here ({error}): install the version of its package that takes them, or give a "
            "make_env of your own"
        ) from error
    if env.spec.max_episode_steps is None:
        warnings.warn(f"{name} has no time limit: episodes may never end without a horizon", stacklevel=2)
    return gym_env(
        env,
        success=description.get("success"),
        observation_keys=description.get("observation_keys") or (),
        terminate_on_success=terminate_on_success,
    )


def registered_builder(description: Mapping[str, Any], **options: Any) -> Callable[..., TransformedEnv]:
    """Return a builder, see :func:`registered_env`, that other processes can use as well.

    A spawned process lacks what a script of the user's has registered in this one, so Gymnasium's entry goes
    with the builder if it can be sent.
    """
    entry = importlib.import_module("gymnasium").registry.get(description["id"])
    try:
        cloudpickle.dumps(entry)
    except Exception:  # the environment's own, of any class: another process has to register it itself
        entry = None
    return partial(registered_env, description, entry=entry, **options)
