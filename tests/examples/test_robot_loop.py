"""The loop of examples/robot_loop.py, on a clock that moves only where the loop sleeps, and as it stands."""

import importlib.util
import re
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.errors import missing, raises, refuses
from tests.toy_env import mlp_actor
from warmprior import PastPrior
from warmprior.deploy import AsyncExecutor
from warmprior.modules.recording import Recording

SCRIPT = Path(__file__).parents[2] / "examples" / "robot_loop.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("robot_loop", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["robot_loop"] = module
    spec.loader.exec_module(module)
    return module


class Clock:
    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(example, monkeypatch):
    """On which decisions take one step."""
    made = Clock()
    monkeypatch.setattr(example, "time", made)
    monkeypatch.setattr(example, "AsyncExecutor", lambda policy, **options: AsyncExecutor(policy, latency=1))
    return made


UNPLUGGED = OSError("the arm does not answer: check its cable")


class Arm:
    """Notes what it is asked for, and fails in steps ``fails``."""

    def __init__(self, clock, fails=(), error=UNPLUGGED):
        self.clock, self.fails, self.error = clock, fails, error
        self.asked, self.seen = [], 0

    def connect(self):
        self.asked.append("connect")

    def observe(self):
        self.seen += 1
        self.clock.now += 0.001
        if self.seen - 2 in self.fails:  # the first is before the loop
            raise self.error
        return {"state": np.zeros(3)}

    def act(self, action):
        assert action.shape == (2,)
        self.asked.append("act")

    def hold(self):
        self.asked.append("hold")

    def stop(self):
        self.asked.append("stop")


policy = partial(mlp_actor, PastPrior(8), observation_dim=3, nfe=1)


def test_an_action_per_period(example, clock):
    arm = Arm(clock)
    record = example.run(arm, policy(), 50.0, 0.99)
    assert arm.asked == ["connect", *["act"] * 50, "stop"]
    assert len(record.starts) == 50 and record.late == record.held == 0
    assert np.allclose(np.diff(record.starts), 0.02)
    assert re.search(r"p50 20\.0, p95 20\.0, max 20\.0 ms", record.report(0.02))


def test_a_late_step_is_counted_and_none_is_hurried(example, clock):
    arm = Arm(clock)
    slow = arm.act

    def act(action):
        slow(action)
        clock.now += 0.05 if len(arm.asked) == 10 else 0.0

    arm.act = act
    record = example.run(arm, policy(), 50.0, 0.99)
    assert record.late == 1
    assert sorted(np.diff(record.starts).round(4))[0] == 0.02


def test_the_robot_holds_where_it_does_not_answer_and_goes_on(example, clock):
    arm = Arm(clock, fails=range(10, 20))
    record = example.run(arm, policy(), 50.0, 0.99)
    assert arm.asked[1:-1] == ["act"] * 10 + ["hold"] * 10 + ["act"] * 30
    assert record.held == 10


@pytest.mark.parametrize("hears", [True, False])
def test_a_robot_that_stops_answering_is_held_and_stopped(example, clock, hears):
    arm = Arm(clock, fails=range(10, 999))
    if not hears:
        arm.hold = lambda: arm.asked.append("hold") or arm.observe()
    with raises(RuntimeError, "check its cable") as stopped:
        example.run(arm, policy(), 50.0, 10.0)
    assert "\n" not in str(stopped.value)
    assert arm.asked[:11] == ["connect", *["act"] * 10]
    assert set(arm.asked[11:-1]) == {"hold"} and arm.asked[-1] == "stop"
    assert len(arm.asked[11:-1]) == pytest.approx(example.PATIENCE * 50, abs=2)


def test_a_decision_that_fails_holds_once_no_action_is_left(example, clock):
    failing = policy()
    calls = []

    def fail(module, inputs):
        calls.append(1)
        if 2 < len(calls) < 20:
            raise RuntimeError("the camera fell off")

    failing.register_forward_pre_hook(fail)
    arm = Arm(clock)
    with pytest.warns(UserWarning, match="camera"):
        record = example.run(arm, failing, 50.0, 0.99)
    assert arm.asked[1:9] == ["act"] * 8  # the whole chunk
    assert record.held and arm.asked[-2:] == ["act", "stop"]


def test_ctrl_c_stops_the_robot(example, clock, capsys):
    arm = Arm(clock, fails=[5], error=KeyboardInterrupt())
    record = example.run(arm, policy(), 50.0, 0.99)
    assert arm.asked == ["connect", *["act"] * 5, "stop"]
    assert len(record.starts) == 6 and "Ctrl-C" in capsys.readouterr().out


def test_what_the_policy_cannot_see_is_said_before_the_robot_moves(example, clock):
    arm = Arm(clock)
    arm.observe = lambda: {"joints": np.zeros(3)}
    refuses(lambda: example.run(arm, policy(), 50.0, 0.99), KeyError, "state", "joints")
    assert arm.asked == ["connect", "stop"]


@pytest.mark.parametrize("camera", [False, True])
def test_demonstrations_are_what_the_arm_shows(example, camera):
    steps = example.demonstrations(camera, 50.0, episodes=2, steps=3)
    shown = example.SimulatedArm(camera)
    shown.connect()
    seen = shown.observe()
    observation = steps["observation"]
    assert set(seen) == ({"state", "front_image"} if camera else {"state"})
    state = observation["state"] if camera else observation
    assert state.shape[1:] == seen["state"].shape
    if camera:
        image = observation["front_image"]
        assert image.shape[1:] == (3, 32, 32) and image.dtype == torch.uint8
        assert seen["front_image"].dtype == np.uint8


def test_the_numbers_of_a_policy_are_printed(example, clock, monkeypatch, capsys):
    recording = Recording("arm", 1, 9, "[2], as recorded", {"state": 4}, rate=25)
    mine = mlp_actor(PastPrior(4), observation_dim=4, nfe=2, recording=recording)
    monkeypatch.setattr(example, "trained", lambda *options: mine)
    assert example.main(["--seconds", "1"]) == 0
    said = capsys.readouterr().out
    assert not missing(said, "NFE 2", "4 actions", "period 40.0 ms", "25 steps")


FEW = ("--seconds", "2", "--iterations", "5")


def test_the_program_runs_in_real_time(example, capsys):
    assert example.main([*FEW, "--camera", "--rate", "20"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"p50 [\d.]+, p95 [\d.]+, max [\d.]+ ms\n\d+ steps, \d+ late, \d+ held", said)


@pytest.mark.parametrize(
    ("options", "fact"),
    [
        (["--unplug", "0.3"], "has not answered"),
        (["--unplug", "0"], "has not answered"),
        (["--rate", "100"], "lower the control rate"),
        (["--rate", "0"], "--rate must be > 0"),
    ],
)
def test_the_program_says_why_it_stopped(example, options, fact, request, capsys):
    if "--unplug" in options:
        request.getfixturevalue("clock")
    assert example.main([*FEW, *options]) == 2
    said = capsys.readouterr().err
    assert said.strip().count("\n") == 0 and fact in said
