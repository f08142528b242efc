from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest
import torch

from tests.data.synthetic import env_args_14
from tests.envs.mimicgen_stub import write_mimicgen

pytest.importorskip("robosuite")

from robosuite.environments.base import REGISTERED_ENVS
from robosuite.robots.robot import Robot

from warmprior.envs import TASKS, RobosuiteEnv
from warmprior.envs.mimicgen import is_mimicgen, register_mimicgen


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


@pytest.mark.parametrize("task", ["stack_d0", "coffee_d0", "threading_d0"])
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


def test_a_file_of_robosuite_14_finds_its_environment(path):
    write_mimicgen(path)
    env = RobosuiteEnv(env_args=env_args_14("coffee_d0"), style="source")
    assert type(env.loop.env).__name__ == "Coffee_D0"
    assert not env.loop.env.lite_physics  # as it was recorded


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


def test_only_what_asks_for_mimicgen_imports_it(path):
    write_mimicgen(path)
    RobosuiteEnv("lift")
    assert "mimicgen" not in sys.modules


def test_an_import_before_ours_registers_nothing_and_does_no_harm(path):
    write_mimicgen(path)
    importlib.import_module("mimicgen")
    assert "Stack_D0" not in REGISTERED_ENVS
    register_mimicgen()
    assert {"Stack_D0", "Coffee_D0", "Threading_D0"} <= set(REGISTERED_ENVS)


def test_missing_package_says_what_to_install(path, monkeypatch):
    monkeypatch.setattr("warmprior.envs.mimicgen.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"not on the package index.*github\.com/NVlabs/mimicgen"):
        RobosuiteEnv("coffee_d0")


def test_a_clone_that_is_not_installed_is_no_other_package(path):
    write_mimicgen(path / "mimicgen")  # its root has the name as well
    with pytest.raises(ImportError, match=r"need NVlabs' package.*run: git clone"):
        RobosuiteEnv("coffee_d0")


@pytest.mark.parametrize("kind", ["package", "module"])
def test_another_package_of_the_name_is_refused_without_running_it(path, kind):
    code = "raise SystemExit('its code ran')"
    if kind == "package":
        (path / "mimicgen" / "envs").mkdir(parents=True)
        (path / "mimicgen" / "__init__.py").write_text(code)
    else:
        (path / "mimicgen.py").write_text(code)
    with pytest.raises(ImportError, match=r"is not NVlabs'.*pip uninstall mimicgen.*git clone"):
        RobosuiteEnv("stack_d0")
    assert "mimicgen" not in sys.modules


def test_package_that_lacks_something_is_named(path):
    write_mimicgen(path, coffee="import robosuite_task_zoo_of_theirs")
    with pytest.raises(ImportError, match=r"mimicgen cannot be imported: .*robosuite_task_zoo_of_th"):
        register_mimicgen()


def test_environment_that_mimicgen_does_not_have(path):
    write_mimicgen(path)
    env_args = env_args_14("stack_d0") | {"env_name": "Juggle_D0"}
    with pytest.raises(ValueError, match="robosuite has no environment 'Juggle_D0'"):
        RobosuiteEnv(env_args=env_args)


def test_the_table_knows_whose_tasks_are_whose():
    mine = {name for name, spec in TASKS.items() if is_mimicgen(spec.env_name)}
    assert mine == {"stack_d0", "coffee_d0", "threading_d0"}
    assert [TASKS[name].object_dim for name in sorted(mine)] == [57, 23, 28]
