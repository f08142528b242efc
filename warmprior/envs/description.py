"""The description of an environment in a saved policy, and the environment built from it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, get_args

from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from warmprior.checks import given
from warmprior.envs.env_args import delta_conventions
from warmprior.envs.gymnasium import registered_builder
from warmprior.envs.robosuite import RobosuiteEnv
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import uncompiled
from warmprior.options.data import Actions
from warmprior.transforms.absolute_actions import AbsoluteActions
from warmprior.transforms.images import CameraImages
from warmprior.transforms.policy import PolicyEnv, policy_transforms

_IMAGES = ("cameras", "size", "rendered", "resize", "fast_rendering", "low_dim_keys")


def environment_description(
    env_args: Mapping[str, Any],
    style: str,
    actions: Actions = "delta",
    images: Mapping[str, Any] | None = None,
    *,
    low_dim_keys: Sequence[str] | None = None,
    horizon: int | None = None,
) -> dict[str, Any]:
    """Return the description from which :func:`environment_of` builds an environment.

    A :class:`~warmprior.WarmPriorActor` keeps it.

    Args:
        env_args: see :class:`RobosuiteEnv`.
        style: see :class:`RobosuiteEnv`.
        actions: the policy's actions: the environment's own pose deltas, or absolute poses (see
            :class:`~warmprior.transforms.AbsoluteActions`).
        images: options of a policy's images, if it sees any: ``"cameras"``, ``"size"``, ``"rendered"`` and
            ``"resize"``, see :class:`~warmprior.transforms.CameraImages`, ``"fast_rendering"``, and
            ``"low_dim_keys"``, its other observations, see :class:`RobosuiteEnv`.

    Keyword Args:
        low_dim_keys: observations of a policy without images, if they differ from the task's.
        horizon: see :class:`RobosuiteEnv`.

    Examples:
        >>> from warmprior.envs import environment_description
        >>> environment_description({"env_name": "Lift", "env_kwargs": {}}, "ph")
        {'robosuite': {'env_args': {'env_name': 'Lift', 'env_kwargs': {}}, 'style': 'ph'}}
    """
    chosen = None if low_dim_keys is None else list(low_dim_keys)
    options = given(low_dim_keys=chosen, horizon=horizon)
    description: dict[str, Any] = {"robosuite": {"env_args": dict(env_args), "style": style, **options}}
    if actions != "delta":
        description["actions"] = actions
    if images is not None:
        description["images"] = {name: images[name] for name in _IMAGES}
    return description


def robosuite_parts(
    description: Mapping[str, Any],
) -> tuple[Callable[..., RobosuiteEnv], dict[str, Transform]]:
    """Return a builder that takes further options of :class:`RobosuiteEnv`, and its transforms by argument.

    Raises ValueError if actions are absolute and the environment does not take pose deltas.
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
        sizes = {name: images[name] for name in ("size", "rendered", "resize")}
        transforms["images"] = CameraImages(images["cameras"], **sizes)
    return partial(RobosuiteEnv, **options), transforms


def environment_parts(
    actor: WarmPriorActor,
) -> tuple[Callable[..., EnvBase], Callable[..., Compose]]:
    """Return a builder of the environment that a policy was made for, and one of the policy's transforms.

    Raises ValueError if the policy keeps no description of an environment.
    """
    description: Any = actor.environment
    adapters: dict[str, Transform] = {}
    if is_registered(description):
        make_env: Callable[..., EnvBase] = registered_builder(description["gymnasium"])
    elif _is_complete(description):
        make_env, adapters = robosuite_parts(description)
    else:
        kept = "" if description is None else f" (it keeps {description})"
        raise ValueError(
            f"the policy keeps no description of an environment of robosuite or Gymnasium{kept}: it was "
            "trained on demonstrations alone. Build your environment with policy_transforms(actor), or give "
            "improve_policy a make_env; for a robot see docs/your_robot.md"
        )
    return make_env, partial(transforms_builder(actor), **adapters)


def transforms_builder(actor: WarmPriorActor) -> Callable[..., Compose]:
    """Return a builder of a policy's transforms that other processes can use as well.

    It holds what the transforms need of the policy, and not its network. Its arguments are further ones of
    :func:`policy_transforms`.
    """
    normalizer = copy.deepcopy(actor.normalizer)
    return partial(
        policy_transforms,
        actor.prior,
        # The environments' normaliser stays on the CPU, even if the policy moves to a GPU.
        normalizer=None if normalizer is None else normalizer.to("cpu"),
        observation_steps=getattr(uncompiled(actor.network), "observation_steps", None),
        see_history=actor.sees_history,
        # A guided policy reads the delay's key.
        delay=None if actor.ode.guidance is None else 0,
    )


def environment_of(actor: WarmPriorActor, **options: Any) -> TransformedEnv:
    """Build the environment that a policy was made for, with the policy's own transforms.

    ``options`` are further options of :class:`RobosuiteEnv`, or of :func:`registered_env`.

    Raises:
        ValueError: if the policy keeps no description of an environment.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.envs import environment_of
        >>> environment_of(WarmPriorActor(VelocityMLP(2, 3, 8), PastPrior(8)))
        Traceback (most recent call last):
            ...
        ValueError: the policy keeps no description of an environment of robosuite or Gymnasium: ...
    """
    make_env, make_transforms = environment_parts(actor)
    return PolicyEnv(make_env(**options), make_transforms())


def environment_name(actor: WarmPriorActor) -> str | None:
    """Return the name in robosuite or Gymnasium of the environment that a policy was made for, if known."""
    description: Any = actor.environment
    if is_registered(description):
        return str(description["gymnasium"]["id"])
    try:
        return str(description["robosuite"]["env_args"]["env_name"])
    except (KeyError, TypeError):  # no description, or the user's own
        return None


_REGISTERED = {"id", "kwargs", "max_episode_steps", "success", "observation_keys"}


def registered_description(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of an environment that :func:`registered_env` builds."""
    return {"gymnasium": {name: environment.get(name) for name in sorted(_REGISTERED)}}


def is_registered(description: Any) -> bool:
    """Return True if a description has the form of :func:`registered_description`."""
    return _has(description, {"gymnasium"}) and _has(description["gymnasium"], _REGISTERED)


def _is_complete(description: Any) -> bool:
    """Return True if a description has only the entries of :func:`environment_description`."""
    return (
        _has(description, {"robosuite"}, {"actions", "images"})
        and _has(description["robosuite"], {"env_args", "style"}, {"low_dim_keys", "horizon"})
        and description.get("actions", "delta") in get_args(Actions)
        and ("images" not in description or _has(description["images"], set(_IMAGES)))
    )


def _has(entry: Any, needed: set[str], optional: Iterable[str] = ()) -> bool:
    """Return True if a part of a description has the needed entries, and no others than the optional ones."""
    return isinstance(entry, Mapping) and entry.keys() - set(optional) == needed
