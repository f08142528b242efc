"""Rotations as quaternions, matrices, rotation vectors and six numbers, over any leading shape.

Quaternions are ``(x, y, z, w)``, as in robomimic's observations. The 6-d form is the first two
*rows* of the rotation matrix, one after the other.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from warmprior.io.extras import require

HAND_TO_SITE = (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5))
"""The rotation from the hand's body, whose quaternion robomimic's observations have, to the gripper's site,
which robosuite's controllers move: -90 degrees about their common z axis."""


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Turn ``(x, y, z, w)`` quaternions ``[..., 4]`` of any length into rotation matrices ``[..., 3, 3]``.

    Examples:
        >>> import torch
        >>> from warmprior.rotation import quaternion_to_matrix
        >>> quaternion_to_matrix(torch.tensor([0.0, 0.0, 1.0, 1.0])).round(decimals=3)[0]
        tensor([ 0., -1.,  0.])
    """
    x, y, z, w = normalize(quaternion, dim=-1).unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)), -1),
        torch.stack((2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)), -1),
        torch.stack((2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)), -1),
    )
    return torch.stack(rows, -2)


def rotvec_to_matrix(rotvec: Tensor) -> Tensor:
    """Turn rotation vectors (axis times angle in radians) ``[..., 3]`` into matrices ``[..., 3, 3]``."""
    return _by_scipy("from_rotvec", rotvec, "as_matrix", (3,))


def matrix_to_rotvec(matrix: Tensor) -> Tensor:
    """Turn rotation matrices ``[..., 3, 3]`` into rotation vectors ``[..., 3]`` of length at most pi."""
    return _by_scipy("from_matrix", matrix, "as_rotvec", (3, 3))


def _by_scipy(read: str, value: Tensor, write: str, form: tuple[int, ...]) -> Tensor:
    """Convert rotations ``[..., *form]`` with scipy's ``Rotation``, without gradients."""
    rotations = require("scipy.spatial.transform", "sim").Rotation
    flat = value.detach().reshape(-1, *form).cpu().double().numpy()
    converted = torch.from_numpy(getattr(getattr(rotations, read)(flat), write)()).to(value)
    return converted.reshape(*value.shape[: value.ndim - len(form)], *converted.shape[1:])


def matrix_to_rotation_6d(matrix: Tensor) -> Tensor:
    """Keep the first two rows of rotation matrices ``[..., 3, 3]``: ``[..., 6]``."""
    return matrix[..., :2, :].flatten(-2)


def rotation_6d_to_matrix(rotation_6d: Tensor) -> Tensor:
    """Turn any six numbers ``[..., 6]`` into a rotation matrix, by Gram-Schmidt.

    The two rows need be neither of unit length nor orthogonal, but must not be parallel.

    Examples:
        >>> import torch
        >>> from warmprior.rotation import rotation_6d_to_matrix
        >>> rotation_6d_to_matrix(torch.tensor([2.0, 0.0, 0.0, 1.0, 3.0, 0.0])).diagonal()
        tensor([1., 1., 1.])
    """
    if rotation_6d.shape[-1:] != (6,):
        raise ValueError(f"a 6-d rotation needs 6 numbers in its last dimension, got {rotation_6d.shape}")
    first = normalize(rotation_6d[..., :3], dim=-1)
    second = rotation_6d[..., 3:]
    second = normalize(second - (first * second).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)), -2)
