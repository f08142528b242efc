"""What a saved policy remembers of its environment, and the environment made from it again."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from warmprior.envs.env_args import delta_conventions
from warmprior.envs.gymnasium import registered_env
from warmprior.envs.robosuite import RobosuiteEnv
from warmprior.modules.actor import WarmPriorActor
from warmprior.transforms.absolute_actions import AbsoluteActions
from warmprior.transforms.images import CameraImages
from warmprior.transforms.policy import policy_transforms

_IMAGES = ("cameras", "size", "fast_rendering", "low_dim_keys")


def environment_description(
    env_args: Mapping[str, Any],
    style: str,
    observation_steps: int,
    actions: Literal["delta", "absolute"] = "delta",
    images: Mapping[str, Any] | None = None,
    *,
    low_dim_keys: Sequence[str] | None = None,
    horizon: int | None = None,
) -> dict[str, Any]:
    """What :func:`environment_of` needs, for :class:`~warmprior.WarmPriorActor` to keep.

    Args:
        env_args: see :class:`RobosuiteEnv`.
        style: likewise.
        observation_steps: ``To``.
        actions: those of the policy: the environment's own pose deltas, or absolute poses (see
            :class:`~warmprior.transforms.AbsoluteActions`).
        images: of a policy that sees some: ``"cameras"`` and ``"size"``, see
            :class:`~warmprior.transforms.CameraImages`, ``"fast_rendering"``, and ``"low_dim_keys"``, what it
            sees besides, see :class:`RobosuiteEnv`.

    Keyword Args:
        low_dim_keys: what a policy without images sees, where that is not the task's own.
        horizon: see :class:`RobosuiteEnv`.

    Examples:
        >>> from warmprior.envs import environment_description
        >>> environment_description({"env_name": "Lift", "env_kwargs": {}}, "ph", observation_steps=2)
        {'robosuite': {'env_args': {'env_name': 'Lift', 'env_kwargs': {}}, 'style': 'ph'},
         'observation_steps': 2}
    """
    description: dict[str, Any] = {
        "robosuite": {"env_args": dict(env_args), "style": style},
        "observation_steps": observation_steps,
    }
    if low_dim_keys is not None:
        description["robosuite"]["low_dim_keys"] = list(low_dim_keys)
    if horizon is not None:
        description["robosuite"]["horizon"] = horizon
    if actions != "delta":
        description["actions"] = actions
    if images is not None:
        description["images"] = {name: images[name] for name in _IMAGES}
    return description


def robosuite_parts(
    description: Mapping[str, Any],
) -> tuple[Callable[..., RobosuiteEnv], dict[str, Transform]]:
    """A function of further options of :class:`RobosuiteEnv`, and the transforms next to it, by argument.

    A ``ValueError`` if the environment takes no pose deltas, from which absolute actions are made.
    """
    options: dict[str, Any] = dict(description["robosuite"])
    transforms: dict[str, Transform] = {}
    if description.get("actions", "delta") == "absolute":
        options["eef_pose"] = True
        transforms["actions"] = AbsoluteActions(*delta_conventions(options["env_args"]))
    images = description.get("images")
    if images is not None:
        options["sim_state"] = True
        options |= {name: images[name] for name in ("low_dim_keys", "fast_rendering")}
        transforms["images"] = CameraImages(images["cameras"], images["size"])
    return partial(RobosuiteEnv, **options), transforms


def environment_parts(actor: WarmPriorActor) -> tuple[Callable[..., EnvBase], Callable[[], Compose]]:
    """What builds the environment that a policy was made for, and what builds the policy's transforms.

    A ``ValueError`` if the policy keeps no description of an environment.
    """
    description: Any = actor.environment
    adapters: dict[str, Transform] = {}
    if is_registered(description):
        make_env: Callable[..., EnvBase] = partial(registered_env, description["gymnasium"])
    elif _is_complete(description):
        make_env, adapters = robosuite_parts(description)
    else:
        kept = "" if description is None else f" (it keeps {description})"
        raise ValueError(
            f"the policy keeps no description of an environment of robosuite or Gymnasium{kept}: it was "
            "trained on demonstrations alone. Build your environment with policy_transforms(actor)"
        )
    normalizer = copy.deepcopy(actor.normalizer)
    transforms = partial(
        policy_transforms,
        actor.prior,
        # The environments' stays on the CPU, wherever the policy goes.
        normalizer=None if normalizer is None else normalizer.to("cpu"),
        **adapters,
        observation_steps=description["observation_steps"],
        see_history=actor.sees_history,
        # A guided policy reads what is left of its last chunk.
        delay=None if actor.ode.guidance is None else 0,
    )
    return make_env, transforms


def environment_of(actor: WarmPriorActor, **options: Any) -> TransformedEnv:
    """The environment that a policy was made for, with the policy's own transforms.

    ``options`` are further ones of :class:`RobosuiteEnv`, or of :func:`registered_env`.

    Raises:
        ValueError: if the policy keeps no description of one.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.envs import environment_of
        >>> environment_of(WarmPriorActor(VelocityMLP(2, 3, 8), PastPrior(8)))
        Traceback (most recent call last):
            ...
        ValueError: the policy keeps no description of an environment of robosuite or Gymnasium: ...
    """
    make_env, make_transforms = environment_parts(actor)
    return TransformedEnv(make_env(**options), make_transforms(), auto_unwrap=False)


def environment_name(actor: WarmPriorActor) -> str | None:
    """What robosuite or Gymnasium calls the environment that a policy was made for, if it is known."""
    description: Any = actor.environment
    if is_registered(description):
        return str(description["gymnasium"]["id"])
    try:
        return str(description["robosuite"]["env_args"]["env_name"])
    except (KeyError, TypeError):  # none, or a description of the user's own
        return None


_REGISTERED = {"id", "kwargs", "max_episode_steps", "success", "observation_keys"}


def registered_description(environment: Mapping[str, Any], observation_steps: int) -> dict[str, Any]:
    """What :func:`environment_of` needs of an environment that :func:`registered_env` builds."""
    return {
        "gymnasium": {name: environment.get(name) for name in sorted(_REGISTERED)},
        "observation_steps": observation_steps,
    }


def is_registered(description: Any) -> bool:
    """Whether it is what :func:`registered_description` gives."""
    try:
        known = description.keys() == {"gymnasium", "observation_steps"}
        return known and description["gymnasium"].keys() == _REGISTERED
    except AttributeError:
        return False


def _is_complete(description: Any) -> bool:
    """Whether it is what :func:`environment_description` gives, and no other option reaches a simulator."""
    try:
        images = description.get("images", dict.fromkeys(_IMAGES))
        return (
            description.keys() - {"actions", "images"} == {"robosuite", "observation_steps"}
            and description["robosuite"].keys() - {"low_dim_keys", "horizon"} == {"env_args", "style"}
            and description.get("actions", "delta") in ("delta", "absolute")
            and images.keys() == set(_IMAGES)
        )
    except AttributeError:  # none, or one of the user's own
        return False
