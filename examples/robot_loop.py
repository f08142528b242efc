"""Run a policy on a robot at a fixed rate: connect, reset, act, hold, stop.

python examples/robot_loop.py                     # ten seconds against a simulated arm, at 50 Hz
python examples/robot_loop.py --camera            # the policy sees the goal only by a camera
python examples/robot_loop.py --decision 0.2      # decisions take longer than a chunk, so the robot holds
python examples/robot_loop.py --unplug 3          # the robot stops answering after three seconds

For your own robot write the five methods of SimulatedArm, and load your policy in play().
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
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDict

from warmprior import PastPrior, WarmPriorActor
from warmprior.checks import check_not_negative, check_positive
from warmprior.deploy import AsyncExecutor
from warmprior.io.script import ERRORS, read_command_line, run_script
from warmprior.training import NetworkOptions, TrainingConfig, train_policy

PATIENCE = 1.0
"""Seconds that the robot holds before the loop gives up."""

DELAY = 0.05
"""The longest expected decision, in seconds."""


class Robot(Protocol):
    """The methods of a robot that the loop calls."""

    def connect(self) -> None:
        """Open the connection; the robot may move from now on."""

    def observe(self) -> dict[str, np.ndarray]:
        """Return the vector ``"state"`` and the images, with the names and units of the demonstrations.

        Give drivers a time limit, and raise OSError (such as TimeoutError) if the robot does not answer.
        """

    def act(self, action: np.ndarray) -> None:
        """Send an action, in the units of the demonstrations, and return at once."""

    def hold(self) -> None:
        """Stop moving: keep the last target, or send deltas or velocities of 0."""

    def stop(self) -> None:
        """Bring the robot to rest and close the connection, even if it no longer answers."""


# ------------------------------------------------------------------------------------ the loop


@dataclass
class Record:
    """Start times of steps, numbers of late and held steps, and delays of chunks in steps.

    A step is late if it starts more than half a period after its due time.
    """

    starts: list[float] = field(default_factory=list)
    late: int = 0
    held: int = 0
    delays: set[int] = field(default_factory=set)

    def report(self, period: float) -> str:
        """Return two lines on periods, late steps and delays."""
        periods = sorted(1e3 * (b - a) for a, b in zip(self.starts, self.starts[1:], strict=False)) or [0.0]
        p50, p95 = statistics.median(periods), periods[math.ceil(0.95 * len(periods)) - 1]
        delays = f"{min(self.delays)} to {max(self.delays)}" if self.delays else "no"
        return (
            f"period {1e3 * period:.1f} ms: p50 {p50:.1f}, p95 {p95:.1f}, max {periods[-1]:.1f} ms\n"
            f"{len(self.starts)} steps, {self.late} late, {self.held} held; chunks were {delays} steps late"
        )


def run(robot: Robot, policy: WarmPriorActor, rate: float, seconds: float) -> Record:
    """Run an episode with an action per period; without an action the robot holds.

    Ctrl-C ends the episode. The robot is stopped in any case.

    Raises:
        RuntimeError: if the robot has held for longer than PATIENCE.
    """
    period, record = 1 / rate, Record()
    with AsyncExecutor(policy, delay=DELAY, control_rate=rate) as executor:
        try:
            robot.connect()
            executor.act(robot.observe())  # the first decision takes longest; the robot is at rest
            executor.reset()  # start every episode with this, which clears the history
            start = due = last_action = time.monotonic()
            while due < start + seconds:
                record.starts.append(time.monotonic())
                if (lag := record.starts[-1] - due) > period / 2:
                    record.late += 1
                    due += lag  # do not catch up, because actions are for a fixed rate
                try:
                    robot.act(executor.act(robot.observe()).numpy())
                    last_action = time.monotonic()
                # The next chunk is late and no action is left, the policy failed, or the robot did not
                # answer. The executor tries again at the next step.
                except Exception as error:
                    record.held += 1
                    with contextlib.suppress(OSError):  # it may not answer this either
                        robot.hold()
                    if time.monotonic() - last_action > PATIENCE:
                        raise RuntimeError(f"held for {PATIENCE:g} s, then stopped: {error}") from error
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
    """Two joints that follow their targets in real time, half of the way in 50 ms.

    The camera shows the joints as a red spot and the goal as a green one, on 96 x 128 pixels.
    """

    def __init__(self, camera: bool, unplug: float = math.inf, seed: int = 0) -> None:
        self.camera, self.unplug = camera, unplug
        self.generator = np.random.default_rng(seed)

    def connect(self) -> None:
        """Start at rest, with a random goal."""
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
        """Return joint positions, and the goal or the camera's image."""
        self._move()
        if np.abs(self.joints - self.goal).max() < 0.05:  # reached: choose another goal
            self.goal = self.generator.uniform(-1, 1, 2)
        return observation_of(self.joints, self.goal, self.camera)

    def act(self, action: np.ndarray) -> None:
        """Set the joint targets."""
        self._move()
        self.target = action

    def hold(self) -> None:
        """Keep the last target."""

    def stop(self) -> None:
        """Note that the arm was stopped; there is nothing to close."""
        self.stopped = True


def observation_of(
    joints: np.ndarray, goal: np.ndarray, camera: bool, size: tuple[int, int] = (96, 128)
) -> dict[str, np.ndarray]:
    """Return an observation of the arm."""
    if not camera:
        return {"state": np.concatenate([joints, goal])}
    rows, columns = (np.linspace(-1.2, 1.2, n) for n in size)
    image = np.zeros((*size, 3), np.uint8)
    for channel, (x, y) in enumerate((joints, goal)):
        near = np.add.outer((rows - y) ** 2, (columns - x) ** 2)
        image[..., channel] = 255 * np.exp(-near / 0.05)
    return {"state": joints.copy(), "front_image": image}


def demonstrations(camera: bool, rate: float, episodes: int = 40, steps: int = 60) -> TensorDict:
    """Return demonstrations that approach the goal; actions are the next joint positions."""
    generator, rows = np.random.default_rng(0), []
    part = 1 - 0.5 ** (8 / rate)
    for episode in range(episodes):
        joints, goal = generator.uniform(-1, 1, (2, 2))
        for _ in range(steps):
            action = joints + part * (goal - joints)
            observed = observation_of(joints, goal, camera, (32, 32))  # the size of the policy's images
            images = {"front_image": observed["front_image"].transpose(2, 0, 1)} if camera else {}
            rows.append((observed["state"], images, action, episode))
            joints = action + generator.normal(0, 0.01, 2)
    states, images, actions, numbers = zip(*rows, strict=True)
    observation = torch.tensor(np.array(states), dtype=torch.float32)
    data: dict = {"observation": observation, "episode": torch.tensor(numbers)}
    if camera:
        pictures = torch.from_numpy(np.array([image["front_image"] for image in images]))
        data["observation"] = TensorDict({"state": observation, "front_image": pictures}, [len(rows)])
    data["action"] = torch.tensor(np.array(actions), dtype=torch.float32)
    return TensorDict(data, [len(rows)])


def trained(camera: bool, rate: float, iterations: int) -> WarmPriorActor:
    """Train a small policy, in a few seconds; a real one needs `joints` (docs/your_robot.md)."""
    seeing: dict[str, Any] = {"encoder": "small", "crop_size": 28} if camera else {}
    return train_policy(
        demonstrations(camera, rate),
        PastPrior(8, correlation=0.5),
        nfe=3,
        network=NetworkOptions("mlp,hidden_dim=128", **seeing),
        training=TrainingConfig(iterations=iterations),
        description=None,
    )


# ----------------------------------------------------------------------------------- together


def main(argv: Sequence[str] | None = None) -> int:
    """Read the options of the command line, play, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add(
        "--rate",
        type=float,
        default=50.0,
        help="control steps per second, where the policy names none (default: %(default)s)",
    )
    add("--seconds", type=float, default=10.0, help="seconds of the episode (default: %(default)s)")
    add("--camera", action="store_true", help="show the policy the goal only by a camera")
    add("--decision", type=float, default=0.0, help="extra seconds per decision (default: %(default)s)")
    add("--unplug", type=float, default=math.inf, help="seconds until the robot stops answering")
    add("--iterations", type=int, default=300, help="iterations of the training (default: %(default)s)")
    # Errors become one line, and PyTorch has one thread, which leaves a core to the loop.
    return run_script(
        lambda: play(read_command_line(lambda: parser.parse_args(argv))),
        "robot_loop.py",
        errors=(*ERRORS, RuntimeError),
    )


def play(options: argparse.Namespace) -> None:
    """Train the policy, run the loop, and report the timing of its steps."""
    check_positive(**{"--rate": options.rate})
    check_not_negative(**{"--decision": options.decision})
    # Yours: load_policy("policies/...") of warmprior.saving.
    policy = trained(options.camera, options.rate, options.iterations)
    policy.register_forward_pre_hook(lambda module, inputs: time.sleep(options.decision))
    robot = SimulatedArm(options.camera, options.unplug)
    recorded = None if policy.recording is None else policy.recording.rate
    rate = recorded or options.rate
    if rate != options.rate:
        print(f"the policy's data have {rate:g} Hz, which replace --rate {options.rate:g}")
    record = run(robot, policy, rate, options.seconds)
    print(f"NFE {policy.sampling.evaluations()}, {policy.prior.chunk_length} actions per chunk")
    print(record.report(1 / rate))


if __name__ == "__main__":
    sys.exit(main())
