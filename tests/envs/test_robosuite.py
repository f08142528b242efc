"""robosuite environments as TorchRL environments."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
import torch

pytest.importorskip("robosuite")

from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

from tests.processes import apart
from warmprior.data.scripted.episode import PLANS
from warmprior.data.scripted.motion import ArmRunner
from warmprior.data.scripted.operators import SKILLED, Demonstrator
from warmprior.envs import RobosuiteEnv, RobosuiteWrapper, rendering_backend
from warmprior.envs import rendering as rendering_module
from warmprior.envs.simulator import make_simulator, task_env_args
from warmprior.envs.tasks import TASKS
from warmprior.io import extras

make_lift = partial(RobosuiteEnv, "lift", horizon=15)


@pytest.fixture(scope="module")
def lift():
    return make_lift()


@pytest.fixture
def can_render():
    if rendering_backend() is None:
        pytest.skip("no OpenGL backend")


def play(env, actions, seed=None):
    if seed is not None:
        env.set_seed(seed, static_seed=True)
    td = env.reset()
    path = [td["observation"]]
    for action in actions:
        td["action"] = action
        td = env.step(td)["next"]
        path.append(td["observation"])
    return torch.stack(path)


def test_specs(lift):
    check_env_specs(lift)
    assert lift.observation_spec["observation"].shape == (TASKS["lift"].observation_dim,)
    assert lift.action_spec.shape == (7,)
    torch.testing.assert_close(lift.action_spec.space.high, torch.ones(7))


@pytest.mark.parametrize("batched", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
def test_specs_batched(batched):
    env = batched(2, make_lift)
    try:
        check_env_specs(env)
    finally:
        env.close(raise_if_closed=False)


@pytest.mark.parametrize("task", ["square", "transport"])
def test_observation_is_the_tasks_state_in_order(task):
    env = RobosuiteEnv(task)
    observation = env.reset()["observation"]
    raw = env._env._get_observations()
    parts = [raw["object-state" if key == "object" else key] for key in TASKS[task].low_dim_keys]
    assert observation.dtype == torch.float32
    assert observation.shape == (TASKS[task].observation_dim,)
    np.testing.assert_allclose(observation.numpy(), np.concatenate(parts), rtol=1e-6, atol=1e-6)
    assert env.action_spec.shape == (TASKS[task].action_dim,)


def test_seed_and_actions_determine_the_episode(lift):
    actions = torch.rand(10, 7, generator=torch.manual_seed(0)) * 2 - 1
    first = play(lift, actions, seed=11)
    assert torch.equal(play(lift, actions, seed=11), first)
    assert torch.equal(play(make_lift(seed=11), actions), first)
    assert not torch.equal(play(lift, actions), first), "the next episode has the next seed"
    assert torch.equal(play(make_lift(), actions), play(lift, actions, seed=0)), "0 by default"


def test_workers_share_out_the_episodes(lift):
    def starts(env, count):
        return [env.reset()["observation"] for _ in range(count)]

    lift.set_seed(40, static_seed=True)
    alone = starts(lift, 4)
    for worker in range(2):
        env = make_lift(seed=40, seed_offset=worker, seed_stride=2)
        assert env.episode_seed == 40 + worker
        for mine, expected in zip(starts(env, 2), alone[worker::2], strict=True):
            assert torch.equal(mine, expected)


def test_leaves_the_global_generators_alone(lift):
    np.random.seed(5)
    expected = np.random.rand(3)
    np.random.seed(5)
    lift.rollout(2)
    RobosuiteEnv("lift").reset()
    np.testing.assert_array_equal(np.random.rand(3), expected)


def run_expert(env, steps, seed=0):
    td = env.reset()
    person = Demonstrator(SKILLED, np.random.default_rng(seed))
    (plan,) = PLANS["lift"](env.loop, person)
    runner = ArmRunner(env.loop, 0, plan, person)
    for _ in range(steps):
        td["action"] = torch.from_numpy(runner.act()).float()
        td = env.step(td)["next"]
        yield td


def test_success_terminates():
    steps = []
    for td in run_expert(RobosuiteEnv("lift"), 200):
        assert td["reward"].item() == float(td["success"].item())
        steps.append(td)
        if td["done"]:
            break
    assert 20 < len(steps) < 150
    assert td["terminated"] and td["success"] and not td["truncated"]
    assert td["reward"].item() == 1


def test_success_need_not_terminate():
    env = RobosuiteEnv("lift", terminate_on_success=False, horizon=100)
    *before, last = run_expert(env, 100)
    assert any(td["success"] for td in before)
    assert not any(td["done"] for td in before)
    assert last["truncated"] and last["done"] and not last["terminated"]


def test_horizon_truncates(lift):
    rollout = lift.rollout(50)
    assert rollout.shape == (15,)
    assert rollout["next", "truncated"].flatten().tolist() == [False] * 14 + [True]
    assert not rollout["next", "terminated"].any()
    assert RobosuiteEnv("square", style="mh").horizon == 500


def test_robosuite_loop_agrees(lift):
    actions = torch.rand(10, 7, generator=torch.manual_seed(1)) * 2 - 1
    slow = play(make_lift(control_loop="robosuite"), actions, seed=2)
    fast = play(lift, actions, seed=2)
    joints = slice(17, 19)  # the fingers; poses in env.step's observations lag by 2 ms
    torch.testing.assert_close(slow[:, joints], fast[:, joints], atol=1e-3, rtol=0)
    torch.testing.assert_close(slow, fast, atol=2e-2, rtol=0)


def test_built_from_the_env_args_of_a_file(lift):
    legacy = {
        "env_name": "Lift",
        "env_version": "1.4.1",
        "type": 1,
        "env_kwargs": {
            "has_renderer": False,
            "has_offscreen_renderer": True,
            "use_camera_obs": True,
            "camera_names": ["agentview"],
            "control_freq": 20,
            "robots": ["Panda"],
            "reward_shaping": True,
            "controller_configs": {
                "type": "OSC_POSE",
                "input_max": 1,
                "input_min": -1,
                "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
                "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
                "kp": 150,
                "damping": 1,
                "impedance_mode": "fixed",
                "control_delta": True,
                "interpolation": None,
            },
        },
    }
    env = RobosuiteEnv(env_args=legacy)
    assert env.horizon == TASKS["lift"].horizon_ph
    actions = torch.rand(8, 7, generator=torch.manual_seed(0)) * 2 - 1
    torch.testing.assert_close(play(env, actions, seed=4), play(lift, actions, seed=4), atol=1e-3, rtol=0)
    rollout = env.rollout(3)
    assert set(rollout["next", "reward"].unique().tolist()) <= {0.0, 1.0}


def test_absolute_actions_are_not_limited_to_fractions():
    env_args = task_env_args("lift")
    arm = env_args["env_kwargs"]["controller_configs"]["body_parts"]["right"]
    arm["input_type"] = "absolute"
    high = RobosuiteEnv(env_args=env_args).action_spec.space.high
    torch.testing.assert_close(high, torch.tensor([2.0] * 3 + [np.pi] * 3 + [1.0]))


def test_environment_outside_the_table():
    env_args = task_env_args("lift")
    env_args["env_name"] = "Door"
    env = RobosuiteEnv(env_args=env_args)
    assert env.horizon == 1000  # robosuite's own
    assert env.rollout(2)["observation"].shape[-1] > 9
    with pytest.raises(ValueError, match=r"no environment 'Coffee'.*import that package first"):
        RobosuiteEnv(env_args={**env_args, "env_name": "Coffee"})
    if find_spec("mimicgen") is None:
        with pytest.raises(ImportError, match="MimicGen's tasks need NVlabs' package"):
            RobosuiteEnv(env_args={**env_args, "env_name": "Coffee_D0"})


def test_environment_outside_the_table_has_the_files_time_limit():
    """Without one an evaluation would wait for a success that may never come."""
    env_args = task_env_args("lift")
    env_args["env_name"] = "Door"
    env_args["env_kwargs"]["horizon"] = 3
    assert RobosuiteEnv(env_args=env_args).rollout(10).shape == (3,)
    assert RobosuiteEnv(env_args=env_args, horizon=2).rollout(10).shape == (2,)
    env_args["env_kwargs"]["horizon"] = "long"
    with pytest.raises(ValueError, match="horizon must be a number of steps, got 'long'"):
        RobosuiteEnv(env_args=env_args)


def test_wrapper_keeps_the_environments_own_time_limit():
    simulator = make_simulator(task_env_args("lift"))
    simulator.ignore_done, simulator.horizon = False, 4
    assert RobosuiteWrapper(simulator).rollout(10).shape == (4,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "juggle"}, "unknown task 'juggle'; choose one of lift, can"),
        ({}, "give either task or env_args"),
        ({"task": "lift", "env_args": {}}, "give either task or env_args"),
        ({"task": "lift", "style": "mg"}, "style is one of ph, mh, source, core, got 'mg'"),
        ({"task": "lift", "horizon": 0}, "horizon must be at least 1"),
        ({"task": "lift", "seed_stride": 0}, "seed_stride must be at least 1"),
        ({"task": "lift", "control_loop": "fast"}, "control_loop is lean or robosuite"),
        ({"task": "lift", "camera_size": (1, 2, 3)}, "camera_size is a side or"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        RobosuiteEnv(**options)


def test_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"warmprior\[sim\]"):
        RobosuiteEnv("lift")


def test_imports_robosuite_late_and_silently():
    code = """
import sys, warmprior.envs
assert "robosuite" not in sys.modules
warmprior.envs.RobosuiteEnv("lift").reset()
import logging
logging.getLogger("robosuite_logs").error("still heard")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "still heard" in line


@apart
def test_pixels(can_render):
    env = make_lift(from_pixels=True, camera_size=(48, 64))
    check_env_specs(env)
    pixels = env.rollout(2)["pixels"]
    assert pixels.shape == (2, 48, 64, 3)
    assert pixels.dtype == torch.uint8
    assert pixels.float().std() > 10


@apart
def test_frames_are_upright(can_render, lift):
    from robosuite.utils import camera_utils

    lift.reset()
    size = 128
    frame = lift.render_frame("agentview", size).astype(int)
    projection = camera_utils.get_camera_transform_matrix(lift._env.sim, "agentview", size, size)
    cube = lift.loop.body("cube_main")[0]
    row, column = camera_utils.project_points_from_world_to_camera(cube, projection, size, size)
    red, green, blue = frame[row, column]
    assert red > 2 * max(green, blue), "the red cube is not where the camera should see it"


@apart
def test_rendering_does_not_change_the_episode(can_render):
    actions = torch.rand(10, 7, generator=torch.manual_seed(2)) * 2 - 1
    plain = play(make_lift(), actions, seed=6)
    assert torch.equal(play(make_lift(from_pixels=True), actions, seed=6), plain)
    env = make_lift()
    td = env.reset()
    assert env.episode_seed == 1
    with pytest.raises(ValueError, match="no camera 'backstage'; choose one of"):
        env.render_frame("backstage")
    assert td["observation"].isfinite().all()


def test_says_how_to_get_a_renderer(monkeypatch):
    monkeypatch.setattr(rendering_module, "rendering_backend", lambda: None)
    with pytest.raises(RuntimeError, match=r"libegl1.*libosmesa6"):
        make_lift().render_frame()
    # A process that tries a backend fails without MuJoCo, too.
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"mujoco is not installed; run: pip install 'warmprior"):
        rendering_module.require_rendering()
