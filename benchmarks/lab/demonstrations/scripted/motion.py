"""Rotations, waypoints, the runner that follows them, and the movements of the tasks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lab.demonstrations.scripted.operators import Demonstrator

if TYPE_CHECKING:
    from warmprior.envs.control_loop import StepLoop

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
    """Return the rotation matrix ``[3, 3]`` about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def down(yaw: float, tilt: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Return the orientation ``[3, 3]`` of a gripper that points down, turned by ``yaw`` and tilted."""
    return turn_z(yaw) @ rotation_matrix(np.array([roll, tilt, 0.0])) @ _HOME


def wrap(angle: float) -> float:
    """Bring an angle into ``[-pi, pi)``."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def yaw_of(matrix: np.ndarray) -> float:
    """Return the heading of a body's x axis in the horizontal plane."""
    return np.arctan2(matrix[1, 0], matrix[0, 0])


def nearest_yaw(yaw: float, home: float, period: float = np.pi) -> float:
    """Return the yaw closest to ``home`` among those that are equivalent by symmetry."""
    return float(home + (yaw - home + period / 2) % period - period / 2)


OPEN, CLOSED = -1.0, 1.0
ANY = 9.0  # a tolerance that every pose meets

Live = Callable[[], np.ndarray]
Plan = Iterator["Waypoint"]


@dataclass
class Waypoint:
    """A goal pose ``[3]`` and ``[3, 3]``, constant or read at every step, and options of the way to it.

    It is reached within ``tol`` metres and ``rtol`` radians, or when ``until`` is true. The arm then stays
    for ``dwell`` steps. After ``limit`` steps it goes on in any case. ``speed`` and ``noise`` are fractions
    of the operator's.
    """

    pos: np.ndarray | Live
    mat: np.ndarray | Live
    grip: float
    tol: float = 0.012
    rtol: float = 0.12
    speed: float = 1.0
    dwell: int = 0
    limit: int = 120
    noise: float = 1.0
    until: Callable[[], bool] | None = None


def _read(value: np.ndarray | Live) -> np.ndarray:
    return value() if callable(value) else value


class ArmRunner:
    """Follows a plan's waypoints with one arm: proportional control, smoothed, with human noise."""

    def __init__(self, loop: StepLoop, arm: int, plan: Plan, person: Demonstrator) -> None:
        self._loop, self._arm, self._plan, self._person = loop, arm, plan, person
        self._noise, self._command = np.zeros(6), np.zeros(6)
        self._pause = 0
        self._finished = False
        self._waypoint = next(plan)
        self._start()

    @property
    def given_up(self) -> bool:
        """Return True if the plan ended a while ago, so that nothing more will happen."""
        return self._finished and self._steps > self._waypoint.limit + 20

    def _start(self) -> None:
        self._steps = self._stayed = 0
        if self._person.chance(self._person.pause):
            self._pause = int(self._person.rng.integers(3, 14))

    def _advance(self) -> None:
        following = next(self._plan, None)
        if following is None:
            self._finished = True
        else:
            self._waypoint = following
            self._start()

    def act(self) -> np.ndarray:
        """Return the arm's next action, ``[7]`` in ``[-1, 1]``."""
        move, turn = self._error()
        while self._is_over(move, turn) and not self._finished:
            self._advance()
            if not self._finished:
                move, turn = self._error()
        person, waypoint = self._person, self._waypoint
        cap = person.speed * waypoint.speed
        # 1.3 times the error per step gives the intended speed, because the controller lags behind.
        move = _limit(person.gain * move / 0.05 * 1.3, cap)
        turn = _limit(person.gain * turn / 0.5 * 1.3, 0.6 * cap)
        target = np.concatenate((move, turn))
        if self._pause > 0:
            self._pause -= 1
            target *= 0.1
        self._command += person.smoothing * (target - self._command)
        self._noise = 0.85 * self._noise + np.sqrt(1 - 0.85**2) * (
            person.rng.normal(size=6) * person.noise * waypoint.noise * _NOISE_SCALE
        )
        pose = np.clip(self._command + self._noise, -1, 1)
        return np.concatenate((pose, [waypoint.grip]))

    def _error(self) -> tuple[np.ndarray, np.ndarray]:
        pos, mat = self._loop.eef(self._arm)
        turn = rotation_vector(_read(self._waypoint.mat) @ mat.T)
        return _read(self._waypoint.pos) - pos, turn

    def _is_over(self, move: np.ndarray, turn: np.ndarray) -> bool:
        waypoint = self._waypoint
        self._steps += 1
        if waypoint.until is None:
            close = np.linalg.norm(move) < waypoint.tol
            near = bool(close and np.linalg.norm(turn) < waypoint.rtol)
        else:
            near = bool(waypoint.until())
        self._stayed += near
        return self._stayed > waypoint.dwell or self._steps > waypoint.limit


_NOISE_SCALE = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])


def _limit(vector: np.ndarray, cap: float) -> np.ndarray:
    return vector * min(1.0, cap / max(1e-9, float(np.linalg.norm(vector))))


def above(loop: StepLoop, body: str, offset: Any = (0.0, 0.0, 0.0)) -> Live:
    """Return a function that reads the position of a body plus an offset in the world frame."""
    shift = np.asarray(offset, dtype=np.float64)
    return lambda: loop.body(body)[0] + shift


def transfer(
    loop: StepLoop,
    person: Demonstrator,
    arm: int,
    pos: np.ndarray | Live,
    mat: np.ndarray | Live,
    grip: float,
    lift: float = 0.0,
    turn: float = 0.0,
    **options: Any,
) -> Plan:
    """Move along a curve, or axis by axis, through one intermediate waypoint.

    ``turn`` is a signed yaw larger than half a turn; half of it is done at the intermediate waypoint.
    """
    start, start_mat = loop.eef(arm)
    end = _read(pos)
    way, path = (start + end) / 2, end - start
    distance = float(np.linalg.norm(path[:2]))
    if person.axiswise:
        top = max(start[2], end[2])
        corner = (end[0], start[1], top) if person.side > 0 else (start[0], end[1], top)
        way = np.array(corner)
    left = np.array([-path[1], path[0], 0.0]) / (distance + 1e-6)
    way = way + left * person.arc * min(1.0, distance / 0.15)
    way[2] = max(way[2], min(start[2], end[2])) + lift
    # Stay within reach, because a stretched arm is singular and gets stuck.
    base = loop.body(f"robot{arm}_base")[0][:2]
    reach = max(0.68, float(np.linalg.norm(end[:2] - base)) - 0.03)
    way[:2] = base + (way[:2] - base) * min(1.0, reach / float(np.linalg.norm(way[:2] - base)))
    last = Waypoint(pos, mat, grip, **options)
    if np.linalg.norm(path) > 0.06 or turn:
        orientation = turn_z(turn / 2) @ start_mat if turn else mat
        yield replace(last, pos=way, mat=orientation, tol=0.04, rtol=0.5 if turn else ANY)
    yield last


def carry(
    loop: StepLoop, arm: int, body: str, pose: Callable[[], tuple[np.ndarray, np.ndarray]]
) -> tuple[Live, Live]:
    """Return the hand position and orientation that put a held body at ``pose()``, by the present grasp."""

    def hand() -> tuple[np.ndarray, np.ndarray]:
        pos, mat = loop.eef(arm)
        body_pos, body_mat = loop.body(body)
        goal_pos, goal_mat = pose()
        turn = goal_mat @ body_mat.T
        return goal_pos + turn @ (pos - body_pos), turn @ mat

    return (lambda: hand()[0]), (lambda: hand()[1])


def bring(loop: StepLoop, arm: int, body: str, goal: Live) -> Live:
    """Return the hand position that puts a held body, which may slip, at ``goal()``."""
    return lambda: goal() + loop.eef(arm)[0] - loop.body(body)[0]


def grasp(
    loop: StepLoop, person: Demonstrator, arm: int, pos: Live, mat: np.ndarray, hover: float = 0.08
) -> Plan:
    """Hover over ``pos()``, perhaps miss once, descend and close the fingers."""

    def over(height: float) -> Live:
        return lambda: pos() + np.array([0.0, 0.0, height])

    yield from transfer(loop, person, arm, over(hover + person.high * 0.5), mat, OPEN, tol=0.02)
    if person.chance(person.clumsy):
        slip = np.append(person.rng.normal(0, 0.03, 2), person.draw(0.02, 0.05))
        stay = int(person.draw(2, 8))
        yield Waypoint(pos() + slip, mat, OPEN, tol=0.015, dwell=stay, limit=60)
        yield Waypoint(over(hover), mat, OPEN, tol=0.02, limit=60)
    yield Waypoint(pos, mat, OPEN, tol=0.008, rtol=0.06, speed=0.6, noise=0.5, limit=70)
    # The fingers need about ten steps to close; lifting earlier drops thin handles.
    stay = int(person.draw(9, 13))
    yield Waypoint(pos(), mat, CLOSED, ANY, ANY, dwell=stay, speed=0.3, noise=0.3)


def release(loop: StepLoop, person: Demonstrator, arm: int, up: float = 0.1) -> Plan:
    """Open the fingers where the hand is, then move up by ``up`` metres."""
    stay = int(person.draw(5, 9))
    yield Waypoint(lambda: loop.eef(arm)[0], lambda: loop.eef(arm)[1], OPEN, ANY, ANY, dwell=stay, noise=0.3)
    pos, mat = loop.eef(arm)
    yield Waypoint(pos + np.array([0.0, 0.0, up]), mat, OPEN, tol=0.03, rtol=ANY)


def lower(loop: StepLoop, arm: int, body: str, goal: np.ndarray, mat: np.ndarray, limit: int = 60) -> Plan:
    """Lower a held body to ``goal``, aiming only 3 cm ahead so that xy is corrected on the way."""

    def pose() -> tuple[np.ndarray, np.ndarray]:
        height = loop.body(body)[0][2]
        return np.append(goal[:2], max(goal[2], height - 0.03)), mat

    pos, orientation = carry(loop, arm, body, pose)
    yield Waypoint(
        pos,
        orientation,
        CLOSED,
        speed=0.7,
        noise=0.3,
        limit=limit,
        until=lambda: loop.body(body)[0][2] < goal[2] + 0.006,
    )


def is_raised(loop: StepLoop, body: str, height: float, by: float = 0.02) -> bool:
    """Return True if a body is more than ``by`` metres above a height."""
    return bool(loop.body(body)[0][2] > height + by)


def is_held(loop: StepLoop, arm: int, body: str, within: float = 0.12) -> bool:
    """Return True if a body is within ``within`` metres of the hand."""
    return bool(np.linalg.norm(loop.body(body)[0] - loop.eef(arm)[0]) < within)
