from functools import partial

import numpy as np
import pytest
import torch

pytest.importorskip("robosuite")

from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.record import PixelRenderTransform

from lab.demonstrations.scripted.experts import EXPERTS
from lab.demonstrations.scripted.motion import ArmRunner
from lab.demonstrations.scripted.operators import SKILLED, Demonstrator
from tests.data.synthetic import env_args_14
from tests.errors import raises
from tests.processes import apart
from tests.toy_env import closing
from warmprior.envs import RobosuiteEnv, rendering_backend
from warmprior.envs.robosuite_tasks import TASKS
from warmprior.envs.simulator import action_limits, make_simulator, task_env_args

make_lift = partial(RobosuiteEnv, "lift", horizon=15, fast_rendering=True)


@pytest.fixture(scope="module")
def lift():
    return make_lift()


@pytest.fixture
def can_render():
    if rendering_backend() is None:
        pytest.skip("no OpenGL backend")


def random_actions(n):
    return torch.rand(n, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1


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


@pytest.mark.parametrize("loop", ["lean", "robosuite"])
def test_objects_are_where_they_are_whatever_else_is_observed(loop):
    """Positions relative to the gripper are part of them."""
    paths = []
    for options in ({}, {"low_dim_keys": ["object"]}):
        with closing(RobosuiteEnv("square", control_loop=loop, seed=4, **options)) as env:
            paths.append(play(env, random_actions(6)))
    torch.testing.assert_close(paths[1], paths[0][:, :14])


@pytest.mark.parametrize(
    ("robot", "controller", "expected"),
    [
        ("Panda", {"type": "OSC_POSE"}, [2.0] * 3 + [np.pi] * 3),
        ("Panda", {"type": "OSC_POSITION"}, [2.0] * 3),
        (
            "Panda",
            {"type": "OSC_POSE", "impedance_mode": "variable_kp"},
            [300.0] * 6 + [2.0] * 3 + [np.pi] * 3,
        ),
        # Every other joint of this arm turns without end.
        ("Kinova3", {"type": "JOINT_POSITION"}, [np.pi, 2.41, np.pi, 2.66, np.pi, 2.23, np.pi]),
    ],
)
def test_absolute_targets_have_the_width_of_the_simulator(robot, controller, expected):
    env_args = task_env_args("lift")
    env_args["env_kwargs"]["robots"] = [robot]
    parts = env_args["env_kwargs"]["controller_configs"]["body_parts"]
    parts["right"] = parts["right"] | controller | {"input_type": "absolute"}
    env = make_simulator(env_args)
    low, high = action_limits(env)
    assert high == pytest.approx([*expected, *[1.0] * (env.action_dim - len(expected))])
    assert low == pytest.approx(np.where(high == 300, 0, -high))  # stiffness is positive
    env.close()


def test_deltas_have_the_range_of_the_controller():
    env_args = task_env_args("lift")
    parts = env_args["env_kwargs"]["controller_configs"]["body_parts"]
    parts["right"] |= {"input_max": 2, "input_min": -0.5, "impedance_mode": "variable", "kp_limits": [10, 40]}
    with closing(RobosuiteEnv(env_args=env_args)) as env:
        space = env.action_spec.space
        assert space.low.tolist() == [0.0] * 6 + [10.0] * 6 + [-0.5] * 6 + [-1.0]
        assert space.high.tolist() == [10.0] * 6 + [40.0] * 6 + [2.0] * 6 + [1.0]
        check_env_specs(env)


def test_absolute_joint_targets():
    env_args = task_env_args("lift")
    parts = env_args["env_kwargs"]["controller_configs"]["body_parts"]
    joints = {"type": "JOINT_POSITION", "input_type": "absolute", "kp": 300, "interpolation": None}
    parts["right"] = joints | {"gripper": parts["right"]["gripper"]}
    env = RobosuiteEnv(env_args=env_args, low_dim_keys=["robot0_joint_pos"])
    assert env.control_loop == "robosuite"  # the lean one has OSC_POSE alone
    panda = [2.8973, 1.7628, 2.8973, 3.0718, 2.8973, 3.7525, 2.8973]  # of Franka's data sheet, in radians
    torch.testing.assert_close(env.action_spec.space.high, torch.tensor([*panda, 1.0]))
    start = env.reset()["observation"]
    target = start + torch.tensor([0.2, -0.1, 0.1, 0.2, -0.2, 0.1, 0.3])
    path = play(env, [torch.cat([target, -torch.ones(1)])] * 25)
    torch.testing.assert_close(path[-1], target, atol=0.02, rtol=0)
    env.close()


@pytest.mark.parametrize("batched", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
def test_specs_batched(batched):
    with closing(batched(2, make_lift)) as env:
        check_env_specs(env)


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
    actions = random_actions(10)
    first = play(lift, actions, seed=11)
    assert torch.equal(play(lift, actions, seed=11), first)
    assert torch.equal(play(make_lift(seed=11), actions), first)
    assert not torch.equal(play(lift, actions), first), "the next episode has the next seed"
    assert torch.equal(play(make_lift(), actions), play(lift, actions, seed=0)), "0 by default"


def run_expert(env, steps, seed=0):
    td = env.reset()
    person = Demonstrator(SKILLED, np.random.default_rng(seed))
    (plan,) = EXPERTS["lift"](env.loop, person)
    runner = ArmRunner(env.loop, 0, plan, person)
    for _ in range(steps):
        td["action"] = torch.from_numpy(runner.act()).float()
        td = env.step(td)["next"]
        yield td


def test_the_simulator_is_closed_once(monkeypatch):
    env, closed = RobosuiteEnv("lift"), []
    monkeypatch.setattr(env._env, "close", lambda: closed.append(1))
    env.close()
    env.close(raise_if_closed=False)
    assert closed == [1] and env.is_closed


def test_success_terminates():
    steps = []
    for td in run_expert(RobosuiteEnv("lift"), 200):
        assert td["reward"].item() == float(td["success"].item())
        steps.append(td)
        if td["done"]:
            break
    assert 20 < len(steps) < 150
    assert td["terminated"] and td["success"] and td["reward"] == 1 and not td["truncated"]


def test_horizon_truncates(lift):
    rollout = lift.rollout(50)
    assert rollout.shape == (15,)
    assert rollout["next", "truncated"].flatten().tolist() == [False] * 14 + [True]
    assert not rollout["next", "terminated"].any()
    assert RobosuiteEnv("square", style="mh").horizon == 500


def test_built_from_the_env_args_of_a_file(lift):
    legacy = env_args_14("lift")
    legacy["env_kwargs"] |= {"reward_shaping": True, "use_camera_obs": True, "camera_names": ["agentview"]}
    env, actions = RobosuiteEnv(env_args=legacy), random_actions(8)
    assert env.horizon == TASKS["lift"].horizon_ph
    torch.testing.assert_close(play(env, actions, seed=4), play(lift, actions, seed=4), atol=1e-3, rtol=0)
    rollout = env.rollout(3)
    assert set(rollout["next", "reward"].unique().tolist()) <= {0.0, 1.0}


def test_bad_options():
    for options, *facts in (
        *(({"task": "juggle"}, "task", "lift, can", "'juggle'"), ({}, "task", "env_args", "env")),
        ({"task": "lift", "style": "mg"}, "style", "ph, mh, source, core", "'mg'"),
        ({"task": "lift", "horizon": 0}, "horizon", 0),
        ({"task": "lift", "control_loop": "fast"}, "control_loop", "lean, robosuite", "'fast'"),
    ):
        with raises(ValueError, *facts):
            RobosuiteEnv(**options)


@apart
def test_pixels(can_render):
    """As TorchRL's transform renders them."""
    pixels = PixelRenderTransform(render_method="render_frame", camera="agentview", size=(48, 64))
    env = TransformedEnv(make_lift(), pixels)
    check_env_specs(env)
    pixels = env.rollout(2)["pixels"]
    assert pixels.shape == (2, 48, 64, 3) and pixels.dtype == torch.uint8
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
