"""One-armed experts: lift, can, square, stack.

A plan is a generator of waypoints that looks at the scene whenever it decides on the next one. A grasp that
failed is noticed and repeated, up to four times.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warmprior.data.scripted.geometry import down, turn_z, wrap, yaw_of
from warmprior.data.scripted.motion import (
    CLOSED,
    Live,
    Plan,
    Waypoint,
    above,
    carry,
    grasp,
    is_held,
    is_raised,
    lower,
    release,
    transfer,
)
from warmprior.data.scripted.operators import Demonstrator
from warmprior.envs.control_loop import StepLoop

_Attempt = Callable[[StepLoop, Demonstrator], Plan]
_ATTEMPTS = 4
_PEG = np.array([0.23, 0.1])
_NUT = "SquareNut_main"
_BASE_X = -0.56  # of the arm, in metres


def _up(height: float) -> np.ndarray:
    return np.array([0.0, 0.0, height])


def _grasp_yaws(yaw: float, period: float) -> list[float]:
    """Equivalent finger directions within the wrist's comfortable range."""
    turns = [wrap(yaw + k * period) for k in range(round(2 * np.pi / period))]
    return [turn for turn in turns if -1.5 < turn < 2.2] or [min(turns, key=abs)]


def _wrist_allows(yaw: float, pos: np.ndarray) -> bool:
    """Whether joint 7 reaches a yaw (unwrapped, 0 at home) with the hand at ``pos``."""
    return bool(-1.9 < yaw - np.arctan2(pos[1], pos[0] - _BASE_X) < 3.4)


def lift(loop: StepLoop, person: Demonstrator) -> list[Plan]:
    """Lift the cube: a plan per arm, in a loop that was just reset."""
    return [_repeat(_try_lift, loop, person)]


def _repeat(attempt: _Attempt, loop: StepLoop, person: Demonstrator) -> Plan:
    for _ in range(_ATTEMPTS):
        yield from attempt(loop, person)


def _try_lift(loop: StepLoop, person: Demonstrator) -> Plan:
    yaw = person.pick(_grasp_yaws(yaw_of(loop.body("cube_main")[1]), np.pi / 2), abs)
    hand = down(yaw, person.draw(-0.08, 0.08), person.draw(-0.08, 0.08))
    spot = above(loop, "cube_main", _up(person.draw(-0.004, 0.008)))
    yield from grasp(loop, person, 0, spot, hand, hover=person.draw(0.05, 0.09))
    aside = [person.draw(-0.02, 0.02), person.draw(-0.02, 0.02), person.draw(0.09, 0.14)]
    yield Waypoint(loop.eef()[0] + np.array(aside), hand, CLOSED, tol=0.02)


def can(loop: StepLoop, person: Demonstrator) -> list[Plan]:
    """Put the can into its bin; see :func:`lift` for arguments."""
    usual = person.choice == 0
    yaw = person.draw(-0.25, 0.25) if usual else person.side * person.draw(0.9, 1.4)
    return [_repeat(lambda loop, person: _try_can(loop, person, yaw), loop, person)]


def _try_can(loop: StepLoop, person: Demonstrator, yaw: float) -> Plan:
    body = "Can_main"
    hand = down(yaw, person.draw(-0.1, 0.1), person.draw(-0.1, 0.1))
    spot = above(loop, body, _up(person.draw(0.0, 0.03)))
    yield from grasp(loop, person, 0, spot, hand, hover=person.draw(0.07, 0.11))
    height = loop.body(body)[0][2]
    rise = _up(person.draw(0.13, 0.17) + person.high * 0.5)
    yield Waypoint(loop.eef()[0] + rise, hand, CLOSED, tol=0.04, rtol=0.5)
    if not is_raised(loop, body, height, 0.04):
        return
    turned = person.draw(-0.2, 0.2) if person.choice == 0 else yaw * person.draw(0.3, 1)
    # Only the near part of the bin is within reach.
    goal = np.array([person.draw(0.125, 0.175), person.draw(0.315, 0.39)])
    if person.side < 0:
        goal[1] += 0.02

    def over(z: float) -> Live:
        return lambda: np.append(goal + (loop.eef()[0] - loop.body(body)[0])[:2], z)

    z = 1.0 + person.high * 0.5 + person.draw(0, 0.03)
    yield from transfer(loop, person, 0, over(z), down(turned), CLOSED, tol=0.04, rtol=0.4)
    if is_held(loop, 0, body):
        z -= person.draw(0.03, 0.08)
        yield Waypoint(over(z), down(turned), CLOSED, tol=0.025, rtol=0.4, limit=40)
        yield from release(loop, person, 0)


def square(loop: StepLoop, person: Demonstrator) -> list[Plan]:
    """Put the square nut over the peg; see :func:`lift` for arguments."""
    return [_repeat(_try_square, loop, person)]


def _try_square(loop: StepLoop, person: Demonstrator) -> Plan:
    pos, mat = loop.body(_NUT)
    yaw = yaw_of(mat)
    # The peg is so far out that the nut's handle must point towards the robot; the hand may then
    # have either yaw. Pairs of yaws at the grasp and at the peg, within the wrist's range:
    pairs = [
        (start, end)
        for first, end in ((yaw - np.pi, 0.0), (yaw, np.pi))
        for start in (first - 2 * np.pi, first, first + 2 * np.pi)
        if _wrist_allows(start, pos) and start < 3.0 and abs(end - start) < 4
    ]
    start, end = person.pick(pairs, lambda pair: 0.7 * abs(pair[0]) + abs(pair[1] - pair[0]))
    handle = np.array([0.056 + person.draw(-0.004, 0.012), person.draw(-0.002, 0.002), person.draw(0, 0.006)])

    def spot() -> np.ndarray:
        nut_pos, nut_mat = loop.body(_NUT)
        return nut_pos + nut_mat @ handle

    yield from grasp(loop, person, 0, spot, down(start), hover=person.draw(0.06, 0.1))
    height = loop.body(_NUT)[0][2]
    rise = _up(person.draw(0.05, 0.08))
    yield Waypoint(loop.eef()[0] + rise, down(start), CLOSED, tol=0.02, rtol=0.3)
    if not is_raised(loop, _NUT, height):
        return
    placed = turn_z(np.pi)
    over = np.append(_PEG, 0.98 + person.high * 0.3 + person.draw(0, 0.03))
    hand_pos, hand_mat = carry(loop, 0, _NUT, lambda: (over, placed))
    turn = end - start if abs(end - start) > 2.4 else 0.0
    yield from transfer(
        loop, person, 0, hand_pos, down(end), CLOSED, lift=0.02, turn=turn, tol=0.04, rtol=0.4
    )
    if not is_held(loop, 0, _NUT):
        return
    yield Waypoint(hand_pos, hand_mat, CLOSED, tol=0.005, rtol=0.05, speed=0.6, noise=0.3, limit=80, dwell=2)
    if not is_held(loop, 0, _NUT):
        return
    yield from lower(loop, 0, _NUT, np.append(_PEG, person.draw(0.88, 0.93)), placed)
    yield from release(loop, person, 0)


def stack(loop: StepLoop, person: Demonstrator) -> list[Plan]:
    """Stack the small cube on the large one; see :func:`lift` for arguments."""
    return [_repeat(_try_stack, loop, person)]


def _try_stack(loop: StepLoop, person: Demonstrator) -> Plan:
    upper, lower_cube = "cubeA_main", "cubeB_main"
    yaw = person.pick(_grasp_yaws(yaw_of(loop.body(upper)[1]), np.pi / 2), abs)
    hand = down(yaw)
    spot = above(loop, upper, _up(person.draw(-0.002, 0.008)))
    yield from grasp(loop, person, 0, spot, hand, hover=person.draw(0.06, 0.09))
    height = loop.body(upper)[0][2]
    rise = _up(person.draw(0.08, 0.12) + person.high)
    yield Waypoint(loop.eef()[0] + rise, hand, CLOSED, tol=0.03, rtol=0.4)
    if not is_raised(loop, upper, height):
        return
    now, below = yaw_of(loop.body(upper)[1]), yaw_of(loop.body(lower_cube)[1])
    turns = [wrap(below + k * np.pi / 2 - now) for k in range(4)]
    turns = [turn for turn in turns if -1.5 < yaw + turn < 2.2] or turns
    aligned = person.pick(turns, abs) if person.chance(0.8) else 0.0
    goal = turn_z(now + aligned)
    top = loop.body(lower_cube)[0] + _up(person.draw(0.10, 0.14) + person.high * 0.5)
    hand_pos, hand_mat = carry(loop, 0, upper, lambda: (top, goal))
    yield from transfer(loop, person, 0, hand_pos, hand_mat(), CLOSED, lift=0.02, tol=0.03, rtol=0.3)
    if not is_held(loop, 0, upper):
        return
    yield Waypoint(hand_pos, hand_mat, CLOSED, tol=0.008, rtol=0.1, speed=0.6, noise=0.4, limit=60)
    yield from lower(loop, 0, upper, loop.body(lower_cube)[0] + _up(0.046), goal)
    yield from release(loop, person, 0)
