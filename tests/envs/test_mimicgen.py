import sys

import numpy as np
import pytest
import torch

from tests.envs.mimicgen_stub import write_mimicgen
from tests.errors import refuses

pytest.importorskip("robosuite")

from robosuite.environments.base import REGISTERED_ENVS
from robosuite.robots.robot import Robot

from warmprior.envs import TASKS, RobosuiteEnv
from warmprior.envs.mimicgen import register_mimicgen


@pytest.fixture
def path(tmp_path, monkeypatch):
    """A folder on Python's path, after which robosuite is what it was before."""
    before, attributes = dict(REGISTERED_ENVS), set(vars(Robot))
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    REGISTERED_ENVS.clear()
    REGISTERED_ENVS.update(before)
    for name in set(vars(Robot)) - attributes:
        delattr(Robot, name)
    for name in list(sys.modules):
        if name.partition(".")[0] == "mimicgen" or name.endswith(".single_arm_env"):
            del sys.modules[name]


@pytest.mark.parametrize("task", ["stack_d0", "coffee_d0"])
def test_tasks_play_in_either_loop(path, capsys, task):
    write_mimicgen(path)
    rollouts = []
    for loop in ("lean", "robosuite"):
        env = RobosuiteEnv(task, seed=3, control_loop=loop)
        assert env.horizon == 400 and env.task is TASKS[task]
        torch.manual_seed(0)
        rollouts.append(env.rollout(6))
    assert rollouts[0]["observation"].shape == (6, TASKS[task].observation_dim)
    # The arm's own numbers come last, and the loops agree on them.
    np.testing.assert_allclose(*(r["observation"][:, -9:-2] for r in rollouts), atol=5e-3)
    assert capsys.readouterr().out == ""


def test_own_tasks_stay_as_they_are(path):
    def play():
        torch.manual_seed(0)
        return RobosuiteEnv("stack", seed=5).rollout(5)["observation"]

    before = play()
    write_mimicgen(path)
    register_mimicgen()
    restored = Robot.controller
    register_mimicgen()
    assert Robot.controller is restored
    assert torch.equal(play(), before)
    env = RobosuiteEnv("transport").loop.env
    sites = [robot.controller.eef_name for robot in env.robots]
    assert sites == ["gripper0_right_grip_site", "gripper1_right_grip_site"]


@pytest.mark.parametrize("kind", ["package", "module"])
def test_another_package_of_the_name_is_refused_without_running_it(path, kind):
    code = "raise SystemExit('its code ran')"
    if kind == "package":
        (path / "mimicgen" / "envs").mkdir(parents=True)
        (path / "mimicgen" / "__init__.py").write_text(code)
    else:
        (path / "mimicgen.py").write_text(code)
    refuses(lambda: RobosuiteEnv("stack_d0"), ImportError, "NVlabs'", "pip uninstall mimicgen", "git clone")
    assert "mimicgen" not in sys.modules
