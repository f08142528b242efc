"""The two-armed expert: the hammer goes from one table to the other, the rubbish out of the way.

The giver and the taker each follow a plan, and wait for one another through a set of events.
"""

from __future__ import annotations

import numpy as np

from warmprior.data.scripted.geometry import down, nearest_yaw, yaw_of
from warmprior.data.scripted.motion import (
    CLOSED,
    OPEN,
    Plan,
    Waypoint,
    above,
    bring,
    carry,
    grasp,
    is_raised,
    lower,
    release,
    transfer,
)
from warmprior.data.scripted.operators import Demonstrator
from warmprior.envs.control_loop import StepLoop

_HAMMER, _LID, _TRASH = "payload_root", "transport_start_bin_lid_root", "trash_main"
_ANY = 9.0
_ATTEMPTS = 4
_BALANCE = 0.017  # from the hammer's origin to the middle between head and handle end, in metres
_GIVER_YAW, _TAKER_YAW = np.pi / 2, -np.pi / 2


def transport(loop: StepLoop, person: Demonstrator) -> list[Plan]:
    """Move the hammer from one table to the other: the giver's and the taker's plan."""
    events: set[str] = set()
    return [_giver(loop, person, events), _taker(loop, person, events)]


def _handle(loop: StepLoop) -> np.ndarray:
    """Direction ``[3]`` of the hammer's handle axis that points to the giver's side."""
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
    yield Waypoint(here, mat, OPEN, _ANY, _ANY, dwell=8, noise=0.3)
    events.add("let go")
    yield Waypoint(here + np.array([0, -0.08, 0.1]), mat, OPEN, tol=0.04, rtol=_ANY)
    yield Waypoint(here + np.array([0, -0.25, 0.1]), mat, OPEN, tol=0.04, rtol=_ANY)


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
    yield Waypoint(loop.eef(1)[0], hand, CLOSED, _ANY, _ANY, dwell=12, noise=0.3)
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
    yield Waypoint(here + np.array([0, 0.1, 0.01]), hand, CLOSED, tol=0.04, rtol=_ANY)
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
