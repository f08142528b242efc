"""Rotations as the scripted experts use them: small numpy functions, angles in radians."""

from __future__ import annotations

import numpy as np

# Gripper pointing down, fingers opening along the world's y axis.
_HOME = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """Turn a rotation vector ``[3]`` into a matrix ``[3, 3]`` (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = np.asarray(vector) / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Turn a rotation matrix ``[3, 3]`` into the shortest rotation vector ``[3]``."""
    m = matrix
    sine_axis = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / 2
    sine, cosine = float(np.linalg.norm(sine_axis)), (np.trace(m) - 1) / 2
    angle = np.arctan2(sine, cosine)
    if cosine > -0.99:
        return sine_axis * (angle / sine if sine > 1e-9 else 1.0)
    # Near half a turn the antisymmetric part vanishes; the symmetric one is (1 - cos) a a^T.
    outer = (m + m.T) / 2 - cosine * np.eye(3)
    axis = outer[:, np.argmax(np.diag(outer))]
    axis = axis / np.linalg.norm(axis)
    return axis * (angle if axis @ sine_axis >= 0 else -angle)


def turn_z(yaw: float) -> np.ndarray:
    """Rotation matrix ``[3, 3]`` about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def down(yaw: float, tilt: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Orientation ``[3, 3]`` of a gripper that points down, turned by ``yaw`` and slightly tilted."""
    return turn_z(yaw) @ rotation_matrix(np.array([roll, tilt, 0.0])) @ _HOME


def wrap(angle: float) -> float:
    """Bring an angle into ``[-pi, pi)``."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def yaw_of(matrix: np.ndarray) -> float:
    """Heading of a body's x axis in the horizontal plane."""
    return np.arctan2(matrix[1, 0], matrix[0, 0])


def nearest_yaw(yaw: float, home: float, period: float = np.pi) -> float:
    """Among the yaws equivalent under a symmetry, the one closest to ``home``."""
    return float(home + (yaw - home + period / 2) % period - period / 2)
