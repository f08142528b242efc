"""The experts: lift, can, square and stack with one arm, transport with two.

A plan is a generator of waypoints that reads the scene before each waypoint. A failed grasp is repeated, up
to four times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from lab.demonstrations.scripted.motion import (
    ANY,
    CLOSED,
    OPEN,
    Live,
    Plan,
    Waypoint,
    above,
    bring,
    carry,
    down,
    grasp,
    is_held,
    is_raised,
    lower,
    nearest_yaw,
    release,
    transfer,
    turn_z,
    wrap,
    yaw_of,
)
from lab.demonstrations.scripted.operators import Demonstrator

if TYPE_CHECKING:
    from warmprior.envs.control_loop import StepLoop

type _Attempt = Callable[[StepLoop, Demonstrator], Plan]
type _Expert = Callable[
    [StepLoop, Demonstrator], list[Plan]
]  # a plan per arm, for a loop that was just reset
_ATTEMPTS = 4
_PEG = np.array([0.23, 0.1])
_NUT = "SquareNut_main"
_BASE_X = -0.56  # position of the arm's base, in metres


def _up(height: float) -> np.ndarray:
    return np.array([0.0, 0.0, height])


def _grasp_yaws(yaw: float, period: float) -> list[float]:
    """Return the equivalent finger directions within the wrist's comfortable range."""
    turns = [wrap(yaw + k * period) for k in range(round(2 * np.pi / period))]
    return [turn for turn in turns if -1.5 < turn < 2.2] or [min(turns, key=abs)]


def _wrist_allows(yaw: float, pos: np.ndarray) -> bool:
    """Return True if joint 7 reaches a yaw (unwrapped, 0 at home) with the hand at ``pos``."""
    return bool(-1.9 < yaw - np.arctan2(pos[1], pos[0] - _BASE_X) < 3.4)


def _repeat(attempt: _Attempt, loop: StepLoop, person: Demonstrator) -> Plan:
    for _ in range(_ATTEMPTS):
        yield from attempt(loop, person)


def _try_lift(loop: StepLoop, person: Demonstrator) -> Plan:
    """Lift the cube."""
    yaw = person.pick(_grasp_yaws(yaw_of(loop.body("cube_main")[1]), np.pi / 2), abs)
    hand = down(yaw, person.draw(-0.08, 0.08), person.draw(-0.08, 0.08))
    spot = above(loop, "cube_main", _up(person.draw(-0.004, 0.008)))
    yield from grasp(loop, person, 0, spot, hand, hover=person.draw(0.05, 0.09))
    aside = [person.draw(-0.02, 0.02), person.draw(-0.02, 0.02), person.draw(0.09, 0.14)]
    yield Waypoint(loop.eef()[0] + np.array(aside), hand, CLOSED, tol=0.02)


def _can(loop: StepLoop, person: Demonstrator) -> list[Plan]:
    """Put the can into its bin."""
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


def _try_square(loop: StepLoop, person: Demonstrator) -> Plan:
    """Put the square nut over the peg."""
    pos, mat = loop.body(_NUT)
    yaw = yaw_of(mat)
    # The peg is so far away that the nut's handle must point towards the robot; the hand may have either
    # yaw. These are pairs of yaws at the grasp and at the peg, within the wrist's range.
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


def _try_stack(loop: StepLoop, person: Demonstrator) -> Plan:
    """Stack the small cube on the large one."""
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


_HAMMER, _LID, _TRASH = "payload_root", "transport_start_bin_lid_root", "trash_main"
_BALANCE = 0.017  # from the hammer's origin to the middle between head and handle end, in metres
_GIVER_YAW, _TAKER_YAW = np.pi / 2, -np.pi / 2


def _transport(loop: StepLoop, person: Demonstrator) -> list[Plan]:
    """Return the plans of giver and taker, who move the hammer from one table to the other.

    The giver takes the lid off the start bin, takes the hammer out and offers it in the middle. The taker
    clears the target bin, takes the hammer and puts it into the bin. They wait for each other by events.
    """
    events: set[str] = set()
    return [_giver(loop, person, events), _taker(loop, person, events)]


def _handle(loop: StepLoop) -> np.ndarray:
    """Return the direction ``[3]`` of the hammer's axis that points to the giver's side."""
    axis = loop.body(_HAMMER)[1][:, 2]
    return -axis if axis[1] > 0 else axis


def _yaw(direction: np.ndarray, home: float) -> float:
    return nearest_yaw(float(np.arctan2(direction[1], direction[0])), home)


def _giver(loop: StepLoop, person: Demonstrator, events: set[str]) -> Plan:
    yield from _remove_lid(loop, person)
    for _ in range(_ATTEMPTS):
        height = loop.body(_HAMMER)[0][2]
        yield from _take_hammer_out(loop, person)
        if is_raised(loop, _HAMMER, height, 0.08):
            break
    middle = [person.draw(-0.03, 0.03), person.draw(-0.01, 0.01)]
    meet = np.array([*middle, 1.03 + person.high * 0.2 + person.draw(0, 0.03)])
    pos, hand = bring(loop, 0, _HAMMER, lambda: meet), down(_GIVER_YAW)
    yield from transfer(loop, person, 0, pos, hand, CLOSED, tol=0.03, rtol=0.3)
    yield Waypoint(pos, hand, CLOSED, tol=0.015, rtol=0.1, speed=0.7, limit=50)
    here, mat = loop.eef(0)
    events.add("offered")
    yield Waypoint(here, mat, CLOSED, until=lambda: "taken" in events, limit=500, noise=0.3)
    yield Waypoint(here, mat, OPEN, ANY, ANY, dwell=8, noise=0.3)
    events.add("let go")
    yield Waypoint(here + np.array([0, -0.08, 0.1]), mat, OPEN, tol=0.04, rtol=ANY)
    yield Waypoint(here + np.array([0, -0.25, 0.1]), mat, OPEN, tol=0.04, rtol=ANY)


def _remove_lid(loop: StepLoop, person: Demonstrator) -> Plan:
    hand = down(_GIVER_YAW)
    spot = above(loop, _LID, [0, person.draw(-0.015, 0.015), person.draw(0.004, 0.01)])
    yield from grasp(loop, person, 0, spot, hand, hover=person.draw(0.06, 0.1))
    rise = np.array([0, 0, person.draw(0.1, 0.14) + person.high * 0.5])
    yield Waypoint(loop.eef(0)[0] + rise, hand, CLOSED, tol=0.03, rtol=0.3)
    goal = np.array([person.draw(-0.22, -0.19), person.draw(-0.47, -0.43), 0.835])
    flat = np.eye(3)
    pos, _ = carry(loop, 0, _LID, lambda: (np.append(goal[:2], 1.03), flat))
    yield from transfer(loop, person, 0, pos, hand, CLOSED, tol=0.04, rtol=0.3)
    yield from lower(loop, 0, _LID, goal, flat, limit=50)
    yield from release(loop, person, 0, up=0.15)


def _take_hammer_out(loop: StepLoop, person: Demonstrator) -> Plan:
    # Near the heavy head, or the hammer tilts in the fingers.
    head_first = _handle(loop) @ loop.body(_HAMMER)[1][:, 2] > 0
    along = person.draw(0.05, 0.06) if head_first else person.draw(0.02, 0.03)

    def spot() -> np.ndarray:
        return loop.body(_HAMMER)[0] + along * _handle(loop) + np.array([0, 0, 0.004])

    hand = down(_yaw(_handle(loop), _GIVER_YAW))
    yield Waypoint(lambda: spot() + np.array([0, 0, 0.24]), hand, OPEN, tol=0.05, rtol=0.4)
    yield from grasp(loop, person, 0, spot, hand, hover=0.1)
    pos, mat = loop.body(_HAMMER)
    # Centred in the bin, so that neither the head nor the end of the handle scrapes a wall.
    centre = (loop.body("transport_start_bin_root")[0] - _BALANCE * mat[:, 2])[:2]
    start = np.append(centre, pos[2] + 0.02)
    yield Waypoint(bring(loop, 0, _HAMMER, lambda: start), hand, CLOSED, tol=0.006, rtol=0.3, limit=30)

    def rising() -> np.ndarray:
        return np.append(centre, min(pos[2] + 0.24, loop.body(_HAMMER)[0][2] + 0.05))

    yield Waypoint(
        bring(loop, 0, _HAMMER, rising),
        hand,
        CLOSED,
        limit=60,
        until=lambda: is_raised(loop, _HAMMER, pos[2], 0.2),
    )


def _taker(loop: StepLoop, person: Demonstrator, events: set[str]) -> Plan:
    for _ in range(_ATTEMPTS):
        yield from _clear_trash(loop, person)
        if loop.body(_TRASH)[0][0] > 0.05:
            break
    wait = np.array([person.draw(-0.03, 0.03), 0.24, 1.15])
    home = down(_TAKER_YAW)
    yield Waypoint(wait, home, OPEN, tol=0.04)
    yield Waypoint(wait, home, OPEN, until=lambda: "offered" in events, limit=600, noise=0.3)

    def spot() -> np.ndarray:
        return loop.body(_HAMMER)[0] - 0.07 * _handle(loop)

    hand = down(_yaw(_handle(loop), _TAKER_YAW))
    yield Waypoint(lambda: spot() + np.array([0, 0.02, 0.09]), hand, OPEN, tol=0.025)
    yield Waypoint(spot, hand, OPEN, tol=0.01, rtol=0.12, speed=0.6, noise=0.4, limit=70)
    yield Waypoint(loop.eef(1)[0], hand, CLOSED, ANY, ANY, dwell=12, noise=0.3)
    here = loop.eef(1)[0]
    events.add("taken")
    yield Waypoint(here, hand, CLOSED, until=lambda: "let go" in events, limit=60, noise=0.3)
    yield from _put_hammer_down(loop, person, here, hand)


def _clear_trash(loop: StepLoop, person: Demonstrator) -> Plan:
    spot = above(loop, _TRASH, [0, 0, person.draw(0, 0.008)])
    hand = down(nearest_yaw(yaw_of(loop.body(_TRASH)[1]), _TAKER_YAW, np.pi / 2))
    home = down(_TAKER_YAW)
    yield Waypoint(above(loop, _TRASH, [0, 0, 0.22]), hand, OPEN, tol=0.05, rtol=0.4)
    yield from grasp(loop, person, 1, spot, hand, hover=0.09)
    yield Waypoint(loop.eef(1)[0] + np.array([0, 0, 0.22]), hand, CLOSED, tol=0.05, rtol=0.4)
    if loop.body(_TRASH)[0][2] <= 0.9:
        return
    aside = [person.draw(-0.06, 0.03), person.draw(-0.08, -0.01)]
    goal = loop.body("transport_trash_bin_root")[0][:2] + np.array(aside)
    over = np.append(goal, 1.04 + person.draw(0, 0.03))
    yield from transfer(loop, person, 1, over, home, CLOSED, tol=0.04, rtol=0.4)
    yield Waypoint(np.append(goal, person.draw(0.95, 1.0)), home, CLOSED, tol=0.03, rtol=0.4)
    yield from release(loop, person, 1, up=0.12)


def _put_hammer_down(loop: StepLoop, person: Demonstrator, here: np.ndarray, hand: np.ndarray) -> Plan:
    aside = [person.draw(-0.02, 0.02), person.draw(-0.01, 0.01)]
    goal = loop.body("transport_target_bin_root")[0][:2] + np.array(aside)
    home = down(_TAKER_YAW)

    def centre() -> np.ndarray:
        return goal - _BALANCE * loop.body(_HAMMER)[1][:2, 2]

    def lowering() -> np.ndarray:
        return np.append(centre(), max(0.875, loop.body(_HAMMER)[0][2] - 0.04))

    over = bring(loop, 1, _HAMMER, lambda: np.append(centre(), 1.08))
    yield Waypoint(here + np.array([0, 0.1, 0.01]), hand, CLOSED, tol=0.04, rtol=ANY)
    yield from transfer(loop, person, 1, over, home, CLOSED, tol=0.03, rtol=0.4)
    yield Waypoint(over, home, CLOSED, tol=0.015, rtol=0.12, limit=60)
    yield Waypoint(
        bring(loop, 1, _HAMMER, lowering),
        home,
        CLOSED,
        speed=0.7,
        limit=60,
        until=lambda: loop.body(_HAMMER)[0][2] < 0.885,
    )
    yield from release(loop, person, 1)


EXPERTS: dict[str, _Expert] = {
    "lift": lambda loop, person: [_repeat(_try_lift, loop, person)],
    "can": _can,
    "square": lambda loop, person: [_repeat(_try_square, loop, person)],
    "stack": lambda loop, person: [_repeat(_try_stack, loop, person)],
    "transport": _transport,
}
