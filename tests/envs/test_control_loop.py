"""The lean control loop against robosuite's own ``env.step``."""

import copy

import numpy as np
import pytest

pytest.importorskip("robosuite")

from robosuite.environments.manipulation.lift import Lift
from robosuite.wrappers import Wrapper

from tests.errors import refuses
from warmprior.envs import RobosuiteEnv
from warmprior.envs.control_loop import ControlLoop, StepLoop
from warmprior.envs.robosuite_tasks import TASKS
from warmprior.envs.simulator import make_simulator, task_env_args

TOLERANCE = 1e-9  # radians, over ten control steps


def random_actions(width):
    return np.random.default_rng(0).normal(0, 0.5, (10, width)).clip(-1, 1)


def joint_path(loop, actions):
    loop.reset(3)
    joints = np.concatenate([robot._ref_joint_pos_indexes for robot in loop.env.robots])
    path = []
    for action in actions:
        loop.step(action)
        path.append(loop.env.sim.data.qpos[joints].copy())
    return np.stack(path)


@pytest.fixture(scope="module")
def lift_env():
    return make_simulator(task_env_args("lift"))


OTHER_INPUTS = ({"input_ref_frame": "base"}, {"input_type": "absolute"})
CASES = [*((task, {}) for task in ("lift", "square", "transport")), *(("lift", c) for c in OTHER_INPUTS)]


@pytest.mark.parametrize(("task", "changes"), CASES)
def test_agrees_with_env_step(task, changes):
    env_args = task_env_args(task)
    env_args["env_kwargs"]["controller_configs"]["body_parts"]["right"].update(changes)
    env = make_simulator(env_args)
    actions = random_actions(TASKS[task].action_dim)
    if "input_type" in changes:
        loop = StepLoop(env)
        loop.reset(3)
        actions[:, :3] = loop.eef()[0] + 0.05 * actions[:, :3]
        actions[:, 3:6] = [np.pi / np.sqrt(2), np.pi / np.sqrt(2), 0]  # pointing down
    expected = joint_path(StepLoop(env), actions)
    assert np.abs(expected - expected[0]).max() > 0.01, "the robot did not move"
    np.testing.assert_allclose(joint_path(ControlLoop(env), actions), expected, atol=TOLERANCE)


def test_same_seed_and_actions_are_bit_identical(lift_env):
    actions = random_actions(7)
    other = ControlLoop(make_simulator(task_env_args("lift")))
    loop = ControlLoop(lift_env)
    loop.reset(99)
    loop.step(actions[0])  # what was played before must not matter
    states = []
    for each in (loop, other, loop):
        each.reset(7)
        for action in actions:
            each.step(action)
        states.append(each.state())
    for other_states in states[1:]:
        np.testing.assert_array_equal(states[0], other_states)
    loop.reset(8)
    assert not np.array_equal(loop.state()[1:8], states[0][1:8])


def test_observations_describe_the_end_of_the_step(lift_env):
    import mujoco

    loop = ControlLoop(lift_env)
    loop.reset(0)
    for action in random_actions(7):
        observations, _ = loop.step(action)
    data = copy.copy(lift_env.sim.data._data)
    mujoco.mj_forward(lift_env.sim.model._model, data)
    site = lift_env.sim.model.site_name2id("gripper0_right_grip_site")
    cube = lift_env.sim.model.body_name2id("cube_main")
    np.testing.assert_allclose(observations["robot0_eef_pos"], data.site_xpos[site], atol=1e-9)
    np.testing.assert_allclose(observations["object"][:3], data.xpos[cube], atol=1e-9)
    np.testing.assert_allclose(loop.eef()[0], data.site_xpos[site], atol=1e-9)
    np.testing.assert_allclose(loop.body("cube_main")[1].ravel(), data.xmat[cube], atol=1e-9)


def test_state_round_trip(lift_env):
    loop = ControlLoop(lift_env)
    before = loop.reset(5)
    state = loop.state()
    assert state.shape == (1 + lift_env.sim.model.nq + lift_env.sim.model.nv,)
    for action in random_actions(7):
        loop.step(action)
    after = loop.set_state(state)
    np.testing.assert_array_equal(loop.state(), state)
    for key, value in before.items():
        np.testing.assert_allclose(after[key], value, atol=1e-9, err_msg=key)
    refuses(lambda: loop.set_state(np.zeros(3)), ValueError, "state", "[3]", "[32]")


def test_refuses_what_it_does_not_implement():
    env_args = task_env_args("lift")
    part = env_args["env_kwargs"]["controller_configs"]["body_parts"]["right"]
    part["impedance_mode"] = "variable"
    refuses(lambda: ControlLoop(make_simulator(env_args)), ValueError, "control_loop='robosuite'")


def of(robot, gripper=None, **options):
    env_args = task_env_args("lift")
    env_args["env_kwargs"] |= {"robots": [robot], **options}
    if gripper is not None:
        env_args["env_kwargs"]["controller_configs"]["body_parts"]["right"]["gripper"] |= gripper
    return make_simulator(env_args)


class Slow(Lift):
    def _pre_action(self, action, policy_step=False):
        super()._pre_action(0.5 * action, policy_step)


@pytest.mark.parametrize("change", ["a moving centre", "bare fingers", "a wrapper", "a subclass", "a sensor"])
def test_what_the_lean_loop_would_bypass_is_stepped_by_robosuite(change):
    if change == "a moving centre":
        env = of("IIWA")
    elif change == "bare fingers":
        env = of("Panda", {"use_action_scaling": False})
    else:
        env = make_simulator(task_env_args("lift"))
    if change == "a wrapper":
        env = Wrapper(env)
    elif change == "a subclass":
        env.__class__ = Slow
    elif change == "a sensor":
        env.modify_observable("cube_pos", "sampling_rate", 2)
    assert RobosuiteEnv(env=env, horizon=5).control_loop == "robosuite"
    refuses(lambda: ControlLoop(env), ValueError, "control_loop='robosuite'")
    assert env.unwrapped.ignore_done if change == "a wrapper" else env.ignore_done


@pytest.mark.parametrize("options", [{"gripper_types": None}, {"controller": "JOINT_TORQUE"}])
def test_robosuites_own_loop_takes_every_arm(options):
    env_args = task_env_args("lift")
    if "controller" in options:
        part = env_args["env_kwargs"]["controller_configs"]["body_parts"]["right"]
        env_args["env_kwargs"]["controller_configs"]["body_parts"]["right"] = {
            "type": "JOINT_TORQUE",
            "interpolation": None,
            "gripper": part["gripper"],
        }
    else:
        env_args["env_kwargs"] |= options
    keys = ["robot0_eef_pos"]
    env = RobosuiteEnv(env=make_simulator(env_args), horizon=5, low_dim_keys=keys)
    assert env.control_loop == "robosuite" and env.rollout(2)["observation"].shape == (2, 3)
