"""Descriptions of environments and actions in robomimic's files, translated to robosuite 1.5."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from warmprior.envs.mimicgen import is_mimicgen
from warmprior.rotation import (
    HAND_TO_SITE,
    matrix_to_rotation_6d,
    quaternion_to_matrix,
    rotvec_to_matrix,
)

_RENAMED = {"damping": "damping_ratio", "damping_limits": "damping_ratio_limits"}
_OUTPUT_MAX = (0.05, 0.05, 0.05, 0.5, 0.5, 0.5)


def _modernize_controller(config: dict[str, Any]) -> dict[str, Any]:
    old = "body_parts" not in config
    if old:
        config = {"type": "BASIC", "body_parts": {"right": config}}
    parts = config["body_parts"]
    parts.update(parts.pop("arms", {}))
    for part in [parts[name] for name in ("right", "left") if name in parts]:
        for before, after in _RENAMED.items():
            if before in part:
                part[after] = part.pop(before)
        delta = part.pop("control_delta", True)
        part.setdefault("input_type", "delta" if delta else "absolute")
        # Up to robosuite 1.4 a delta was in the world frame; from 1.5 on it is in the robot's base
        # frame unless the file says otherwise. The two differ for bases that face each other.
        part.setdefault("input_ref_frame", "world" if old else "base")
        part.setdefault("gripper", {"type": "GRIP"})
    return config


def modernize_env_args(env_args: Mapping[str, Any]) -> dict[str, Any]:
    """Rewrite the ``env_args`` of any robomimic file for robosuite 1.5.

    :doc:`/data` has a table of the changes. Some files published for 1.5 still have the old description, so
    the content of the file decides, not its version. The dynamics of old data are kept
    (``lite_physics=False``). A second application changes nothing.

    Args:
        env_args: the parsed JSON of the attribute ``data.attrs["env_args"]``, with ``env_name`` and
            ``env_kwargs``. It is not modified.

    Returns:
        A deep copy for ``robosuite.make(new["env_name"], **new["env_kwargs"])``.

    Raises:
        ValueError: if ``env_name`` or ``env_kwargs`` is missing, or ``env_kwargs`` names another environment.

    Examples:
        >>> from warmprior.envs import modernize_env_args
        >>> old = {"type": "OSC_POSE", "damping": 1, "control_delta": True}
        >>> new = modernize_env_args(
        ...     {"env_name": "Lift", "env_kwargs": {"robots": ["Panda"], "controller_configs": old}})
        >>> arm = new["env_kwargs"]["controller_configs"]["body_parts"]["right"]
        >>> arm["damping_ratio"], arm["input_type"], arm["input_ref_frame"]
        (1, 'delta', 'world')
    """
    if missing := {"env_name", "env_kwargs"} - set(env_args):
        raise ValueError(f"env_args lacks {sorted(missing)}; it has {sorted(env_args)}")
    new = copy.deepcopy(dict(env_args))
    kwargs = new["env_kwargs"]
    if kwargs.pop("env_name", new["env_name"]) != new["env_name"]:
        raise ValueError(
            f"env_args name two environments: env_name is {new['env_name']!r}, and in env_kwargs "
            f"{env_args['env_kwargs']['env_name']!r}"
        )
    configs = kwargs.get("controller_configs")
    if configs:
        listed = configs if isinstance(configs, list) else [configs]
        old = any("body_parts" not in config for config in listed)
        listed = [_modernize_controller(config) for config in listed]
        kwargs["controller_configs"] = listed if isinstance(configs, list) else listed[0]
        # MimicGen's tasks have the full step (see register_mimicgen), and some refuse the argument.
        if not is_mimicgen(new["env_name"]):
            kwargs.setdefault("lite_physics", not old)
    layout = kwargs.get("env_configuration")
    if isinstance(layout, str):
        kwargs["env_configuration"] = layout.removeprefix("single-arm-")
    if "mount_types" in kwargs:
        kwargs["base_types"] = kwargs.pop("mount_types")
    # This is the index of a GPU on the machine that recorded the data.
    kwargs.pop("render_gpu_device_id", None)
    return new


def _arm_controller(env_args: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return an environment's keyword arguments for robosuite 1.5, and those of its first arm."""
    kwargs = modernize_env_args(env_args)["env_kwargs"]
    config = kwargs.get("controller_configs") or {"body_parts": {"right": {"type": "OSC_POSE"}}}
    return kwargs, (config[0] if isinstance(config, list) else config)["body_parts"]["right"]


def declared_actions(env_args: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the input type of an ``OSC_POSE`` controller, ``"delta"`` or ``"absolute"``, and its frame.

    The result is ``None`` for another controller.
    """
    _, part = _arm_controller(env_args)
    if part.get("type") != "OSC_POSE":
        return None
    return part.get("input_type", "delta"), part.get("input_ref_frame", "base")


def delta_conventions(env_args: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """Return the units and the frame of an environment's pose deltas.

    The units are ``output_max`` ``[6]`` float64, the motion at an input of 1 (3 in metres, 3 in radians). The
    frame is ``base_rotation`` ``[arms, 3, 3]`` float64, from the frame of the deltas to the world.

    Raises:
        ValueError: if the controller is not an ``OSC_POSE`` one fed with deltas in ``[-1, 1]``.

    Examples:
        >>> from warmprior.envs import delta_conventions
        >>> arm = {"type": "OSC_POSE", "output_max": [0.05] * 3 + [0.5] * 3}
        >>> kwargs = {"robots": "Panda", "controller_configs": arm}
        >>> output_max, base_rotation = delta_conventions({"env_name": "Lift", "env_kwargs": kwargs})
        >>> output_max.tolist(), base_rotation.shape
        ([0.05, 0.05, 0.05, 0.5, 0.5, 0.5], torch.Size([1, 3, 3]))
    """
    kwargs, part = _arm_controller(env_args)
    if part.get("type") != "OSC_POSE" or part.get("input_type", "delta") != "delta":
        kind = f"{part.get('type')} with input_type={part.get('input_type')!r}"
        raise ValueError(f"expected OSC_POSE deltas, got {kind}; use the actions as recorded")
    output_max = torch.as_tensor(part.get("output_max", _OUTPUT_MAX), dtype=torch.float64).expand(6)
    output_min = torch.as_tensor(part.get("output_min", -output_max), dtype=torch.float64).expand(6)
    limits = (part.get("input_min", -1), part.get("input_max", 1))
    if not torch.equal(output_min, -output_max) or limits != (-1, 1):
        raise ValueError("only symmetric deltas are supported: input -1..1 and output_min = -output_max")
    robots = kwargs.get("robots", ["Panda"])
    arms = 1 if isinstance(robots, str) else len(robots)
    turned = arms == 2 and kwargs.get("env_configuration", "default") in ("default", "opposed")
    yaws = torch.zeros(arms, dtype=torch.float64)
    if turned and part.get("input_ref_frame", "base") == "base":
        yaws = torch.tensor([math.pi / 2, -math.pi / 2], dtype=torch.float64)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return output_max.clone(), rotvec_to_matrix(yaws[:, None] * axis)


def _per_arm(name: str, value: Tensor, width: int, arms: int | None = None) -> Tensor:
    widths = [n * width for n in ((1, 2) if arms is None else (arms,))]
    if value.ndim == 0 or value.shape[-1] not in widths:
        raise ValueError(f"{name} must have {' or '.join(map(str, widths))} columns, got {list(value.shape)}")
    return value.double().unflatten(-1, (-1, width))


def absolute_actions(
    actions: Tensor,
    eef_pos: Tensor,
    eef_quat: Tensor,
    *,
    output_max: Tensor | Sequence[float] = _OUTPUT_MAX,
    base_rotation: Tensor | None = None,
) -> Tensor:
    """Turn pose deltas into the poses that they target, in the world frame.

    The goal position is ``eef_pos + output_max[:3] * clip(delta)`` and the goal orientation
    ``exp(output_max[3:] * clip(turn)) @ R_site``. ``R_site`` is the frame of the gripper site; robomimic's
    ``robot0_eef_quat`` is that of the hand body, 90 degrees away, and is converted here.

    Args:
        actions: ``[..., 7]`` or, for two arms, ``[..., 14]``: position delta, rotation delta and gripper.
        eef_pos: ``[..., 3]`` or ``[..., 6]`` gripper positions before the action, in metres.
        eef_quat: ``[..., 4]`` or ``[..., 8]`` hand orientations before the action, ``(x, y, z, w)``.
        output_max: ``[6]``, the motion at an input of 1, in metres and radians.
        base_rotation: ``[arms, 3, 3]``, the rotation from the frame of the deltas to the world; ``None`` if
            the frames are the same (see :func:`delta_conventions`).

    Returns:
        Poses ``[..., 10]`` or ``[..., 20]`` in the dtype of ``actions``: per arm the position in metres, the
        first two rows of the rotation matrix, and the gripper.

    Raises:
        ValueError: if a width does not fit one or two arms, or the widths disagree.

    Examples:
        >>> import torch
        >>> from warmprior.envs import absolute_actions
        >>> action = torch.tensor([1.0, 0, 0, 0, 0, 0, -1.0])
        >>> position, hand = torch.tensor([0.1, 0, 1.0]), torch.tensor([0, 0, 1.0, 1.0])
        >>> absolute_actions(action, position, hand).round(decimals=3)[:3]
        tensor([0.1500, 0.0000, 1.0000])
    """
    delta = _per_arm("actions", actions, 7)
    arms = delta.shape[-2]
    position = _per_arm("eef_pos", eef_pos, 3, arms)
    hand = quaternion_to_matrix(_per_arm("eef_quat", eef_quat, 4, arms))
    rotation = hand @ quaternion_to_matrix(hand.new_tensor(HAND_TO_SITE))
    scale = torch.as_tensor(output_max, dtype=torch.float64, device=delta.device)
    step = (delta[..., :6].clamp(-1, 1) * scale).unflatten(-1, (2, 3))
    if base_rotation is not None:
        # Both vectors are rotated, because B exp(r) B^T = exp(B r).
        step = step @ base_rotation.to(step).mT
    goal = position + step[..., 0, :]
    turned = matrix_to_rotation_6d(rotvec_to_matrix(step[..., 1, :]) @ rotation)
    return torch.cat((goal, turned, delta[..., 6:]), -1).flatten(-2).to(actions.dtype)
