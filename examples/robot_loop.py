"""A policy on a robot, at a fixed rate: connect, reset, act, hold, stop.

python examples/robot_loop.py                     # ten seconds against a simulated arm, at 50 Hz
python examples/robot_loop.py --camera            # the policy sees a camera, and not where the goal is
python examples/robot_loop.py --decision 0.2      # decisions take longer than a chunk lasts: the robot holds
python examples/robot_loop.py --unplug 3          # the robot stops answering after three seconds

For your own robot write the five methods of SimulatedArm, and load your policy in main().
"""

from __future__ import annotations

import argparse
import contextlib
import math
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from tensordict import TensorDict

from warmprior import PastPrior, WarmPriorActor
from warmprior.deploy import AsyncExecutor
from warmprior.training import NetworkOptions, TrainingConfig, train_policy

PATIENCE = 1.0
"""Seconds for which the robot is held before the loop gives up."""

DELAY = 0.05
"""The longest decision that is expected, in seconds."""

CHUNK, NFE = 8, 3


class Robot(Protocol):
    """The loop calls these methods of a robot."""

    def connect(self) -> None:
        """Open the connection; the robot may move from here on."""

    def observe(self) -> dict[str, np.ndarray]:
        """The vector ``"state"`` and the images, under the names and in the units of the demonstrations.

        Give drivers a time limit: an OSError (a TimeoutError is one) says that the robot did not answer.
        """

    def act(self, action: np.ndarray) -> None:
        """Send an action, in the units of the demonstrations, and return at once."""

    def hold(self) -> None:
        """Stay where it is. With joint or pose targets the last one does; deltas and velocities become 0."""

    def stop(self) -> None:
        """Bring the robot to rest and close the connection; also where it no longer answers."""


# ------------------------------------------------------------------------------------ the loop


@dataclass
class Record:
    """When steps began, how many by more than half a period late, or held; delays of chunks in steps."""

    starts: list[float] = field(default_factory=list)
    late: int = 0
    held: int = 0
    delays: set[int] = field(default_factory=set)

    def report(self, period: float) -> str:
        """Two lines."""
        periods = sorted(1e3 * (b - a) for a, b in zip(self.starts, self.starts[1:], strict=False)) or [0.0]
        p50, p95 = statistics.median(periods), periods[math.ceil(0.95 * len(periods)) - 1]
        delays = f"{min(self.delays)} to {max(self.delays)}" if self.delays else "no"
        return (
            f"period {1e3 * period:.1f} ms: p50 {p50:.1f}, p95 {p95:.1f}, max {periods[-1]:.1f} ms\n"
            f"{len(self.starts)} steps, {self.late} late, {self.held} held; chunks were {delays} steps late"
        )


def run(robot: Robot, policy: WarmPriorActor, rate: float, seconds: float) -> Record:
    """One episode: an action per period, from the chunk that is there; the robot holds where there is none.

    Ctrl-C ends it, and so do problems that last longer than PATIENCE, as a RuntimeError. The robot is stopped
    in any case.
    """
    period, record = 1 / rate, Record()
    with AsyncExecutor(policy, delay=DELAY, control_rate=rate) as executor:
        try:
            robot.connect()
            executor.act(robot.observe())  # the first decision takes longest, and the robot rests
            executor.reset()  # begin every episode with it: the history of the last one is no history
            begun = due = good = time.monotonic()
            while due < begun + seconds:
                record.starts.append(time.monotonic())
                if (lag := record.starts[-1] - due) > period / 2:
                    record.late += 1
                    due += lag  # do not hurry afterwards: actions are for a fixed rate
                try:
                    robot.act(executor.act(robot.observe()).numpy())
                    good = time.monotonic()
                # No action is left and the next chunk is late, the policy failed, or the robot did not
                # answer. The executor tries again at the next step.
                except Exception as error:
                    record.held += 1
                    with contextlib.suppress(OSError):  # it may not hear this either
                        robot.hold()
                    if time.monotonic() - good > PATIENCE:
                        raise RuntimeError(f"held for {PATIENCE:g} s, and stopped: {error}") from error
                record.delays.update(executor.delays)
                due += period
                time.sleep(max(0.0, due - time.monotonic()))
        except KeyboardInterrupt:
            print("stopped by Ctrl-C")
        finally:
            robot.stop()
    return record


# -------------------------------------------------------------------------- a simulated robot


class SimulatedArm:
    """Two joints that follow their targets in real time, each half of the way in 50 ms.

    The camera shows the arm's joints as a red spot and the goal as a green one, on 96 x 128 pixels.
    """

    def __init__(self, camera: bool, unplug: float = math.inf, seed: int = 0) -> None:
        self.camera, self.unplug = camera, unplug
        self.generator = np.random.default_rng(seed)

    def connect(self) -> None:
        """Start at rest, with a goal somewhere else."""
        self.joints, self.goal = self.generator.uniform(-1, 1, (2, 2))
        self.target = self.joints.copy()
        self.connected = self.moved = time.monotonic()
        self.stopped = False

    def _move(self) -> None:
        now = time.monotonic()
        if now - self.connected > self.unplug:
            raise TimeoutError("the arm has not answered for 20 ms: check its cable")
        self.joints += (self.target - self.joints) * (1 - 0.5 ** ((now - self.moved) / 0.05))
        self.moved = now

    def observe(self) -> dict[str, np.ndarray]:
        """Joint positions, and the goal or the camera's image."""
        self._move()
        if np.abs(self.joints - self.goal).max() < 0.05:  # another one
            self.goal = self.generator.uniform(-1, 1, 2)
        return seen(self.joints, self.goal, self.camera)

    def act(self, action: np.ndarray) -> None:
        """Joint targets."""
        self._move()
        self.target = action

    def hold(self) -> None:
        """The last target stays."""

    def stop(self) -> None:
        """Nothing is left to close."""
        self.stopped = True


def seen(
    joints: np.ndarray, goal: np.ndarray, camera: bool, size: tuple[int, int] = (96, 128)
) -> dict[str, np.ndarray]:
    """An observation of the arm."""
    if not camera:
        return {"state": np.concatenate([joints, goal])}
    rows, columns = (np.linspace(-1.2, 1.2, n) for n in size)
    image = np.zeros((*size, 3), np.uint8)
    for channel, (x, y) in enumerate((joints, goal)):
        near = np.add.outer((rows - y) ** 2, (columns - x) ** 2)
        image[..., channel] = 255 * np.exp(-near / 0.05)
    return {"state": joints.copy(), "front_image": image}


def demonstrations(camera: bool, rate: float, episodes: int = 40, steps: int = 60) -> TensorDict:
    """The joints go a part of the way to the goal at every step; actions are the next joint positions."""
    generator, rows = np.random.default_rng(0), []
    part = 1 - 0.5 ** (8 / rate)
    for episode in range(episodes):
        joints, goal = generator.uniform(-1, 1, (2, 2))
        for _ in range(steps):
            action = joints + part * (goal - joints)
            found = seen(joints, goal, camera, (32, 32))  # as small and square as policies see images
            images = {"front_image": found["front_image"].transpose(2, 0, 1)} if camera else {}
            rows.append((found["state"], images, action, episode))
            joints = action + generator.normal(0, 0.01, 2)
    states, images, actions, numbers = zip(*rows, strict=True)
    observation = torch.tensor(np.array(states), dtype=torch.float32)
    steps_of: dict = {"observation": observation, "episode": torch.tensor(numbers)}
    if camera:
        pictures = torch.from_numpy(np.array([image["front_image"] for image in images]))
        steps_of["observation"] = TensorDict({"state": observation, "front_image": pictures}, [len(rows)])
    steps_of["action"] = torch.tensor(np.array(actions), dtype=torch.float32)
    return TensorDict(steps_of, [len(rows)])


def trained(camera: bool, rate: float, iterations: int) -> WarmPriorActor:
    """A small policy, in a few seconds."""
    return train_policy(
        demonstrations(camera, rate),
        PastPrior(CHUNK, correlation=0.5),
        nfe=NFE,
        network=NetworkOptions(hidden_dim=128, encoder="small", crop_size=28),
        training=TrainingConfig(iterations=iterations),
        description=None,
    )


# ----------------------------------------------------------------------------------- together


def main(argv: Sequence[str] | None = None) -> int:
    """Train the policy, run the loop, and say how even its steps were."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rate", type=float, default=50.0, help="control steps per second")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--camera", action="store_true", help="see the goal by a camera alone")
    parser.add_argument(
        "--decision", type=float, default=0.0, help="make every decision take longer, in seconds"
    )
    parser.add_argument("--unplug", type=float, default=math.inf, help="when the robot stops answering")
    parser.add_argument("--iterations", type=int, default=300, help="of the training")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)  # the loop needs a core of its own
    policy = trained(options.camera, options.rate, options.iterations)  # yours: load_policy("policies/...")
    policy.register_forward_pre_hook(lambda module, inputs: time.sleep(options.decision))
    robot = SimulatedArm(options.camera, options.unplug)
    try:
        record = run(robot, policy, options.rate, options.seconds)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"NFE {NFE}, {CHUNK} actions per chunk, {'camera' if options.camera else 'no camera'}")
    print(record.report(1 / options.rate))
    return 0


if __name__ == "__main__":
    sys.exit(main())
