import copy
from contextlib import closing

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.data.synthetic import env_args_14, env_args_15
from tests.errors import refuses
from warmprior.envs.env_args import absolute_actions, delta_conventions, modernize_env_args
from warmprior.rotation import (
    matrix_to_rotation_6d,
    matrix_to_rotvec,
    quaternion_to_matrix,
    rotation_6d_to_matrix,
    rotvec_to_matrix,
)

Rotation = pytest.importorskip("scipy.spatial.transform").Rotation

TASKS = ("lift", "can", "square", "transport")
finite = st.floats(-4, 4, allow_nan=False, width=64)


def _quaternions(n, seed=0):
    return Rotation.random(n, random_state=seed).as_quat()


@settings(deadline=None, max_examples=200)
@given(arrays(np.float64, (3,), elements=finite))
def test_rotvec_round_trip_against_scipy(rotvec):
    reference = Rotation.from_rotvec(rotvec)
    matrix = rotvec_to_matrix(torch.from_numpy(rotvec))
    np.testing.assert_allclose(matrix, reference.as_matrix(), atol=1e-12)
    back = matrix_to_rotvec(matrix).numpy()
    assert np.linalg.norm(back) <= np.pi + 1e-9
    np.testing.assert_allclose(Rotation.from_rotvec(back).as_matrix(), reference.as_matrix(), atol=1e-9)
    again = matrix_to_rotvec(rotation_6d_to_matrix(matrix_to_rotation_6d(matrix))).numpy()
    np.testing.assert_allclose(Rotation.from_rotvec(again).as_matrix(), reference.as_matrix(), atol=1e-9)


def test_quaternions_against_scipy():
    quaternions = _quaternions(50)
    expected = Rotation.from_quat(quaternions).as_matrix()
    np.testing.assert_allclose(quaternion_to_matrix(torch.from_numpy(quaternions)), expected)
    # Neither sign nor length of a quaternion means anything.
    np.testing.assert_allclose(quaternion_to_matrix(torch.from_numpy(-3 * quaternions)), expected, atol=1e-12)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("make", [env_args_14, env_args_15])
def test_modernize_is_pure_and_idempotent(task, make):
    before = make(task)
    kept = copy.deepcopy(before)
    once = modernize_env_args(before)
    assert before == kept
    assert modernize_env_args(once) == once
    # Some writers repeat the name among the options, and robosuite would be given it twice.
    kept["env_kwargs"]["env_name"] = kept["env_name"]
    assert modernize_env_args(kept) == once
    del kept["env_kwargs"]["env_name"]
    once["env_kwargs"]["controller_configs"]["body_parts"]["right"]["kp"] = -1
    assert before == kept


def test_modernize_old_description():
    new = modernize_env_args(env_args_14("transport"))["env_kwargs"]
    arm = new["controller_configs"]["body_parts"]["right"]
    assert new["controller_configs"]["type"] == "BASIC"
    assert arm["damping_ratio"] == 1 and arm["damping_ratio_limits"] == [0, 10]
    assert arm["input_type"] == "delta" and arm["input_ref_frame"] == "world"
    assert arm["gripper"] == {"type": "GRIP"}
    assert not {"damping", "damping_limits", "control_delta"} & arm.keys()
    assert new["env_configuration"] == "opposed" and new["lite_physics"] is False
    assert "render_gpu_device_id" not in new


def test_delta_conventions_read_the_controller():
    meta = env_args_14("square")
    limits = [0.1] * 3 + [0.3] * 3
    own = {"output_max": limits, "output_min": [-limit for limit in limits]}
    meta["env_kwargs"]["controller_configs"] |= own
    output_max, base = delta_conventions(meta)
    assert output_max.tolist() == limits
    torch.testing.assert_close(base, torch.eye(3, dtype=torch.float64)[None])
    meta["env_kwargs"]["controller_configs"]["output_min"] = [-0.2] * 6
    refuses(lambda: delta_conventions(meta), ValueError, "symmetric")


@pytest.mark.parametrize(("task", "frame"), [("lift", "world"), ("transport", "base")])
def test_absolute_goal_is_the_controllers_own_goal(task, frame):
    """The controller, fed with a delta, must aim at the pose that was computed without it."""
    suite = pytest.importorskip("robosuite")
    meta = env_args_15(task, frame)
    env = suite.make(meta["env_name"], **modernize_env_args(meta)["env_kwargs"])
    with closing(env):
        np.random.seed(0)
        obs, arms = env.reset(), range(len(env.robots))
        action = np.random.default_rng(0).uniform(-1, 1, env.action_dim)
        poses = [np.concatenate([obs[f"robot{a}_{key}"] for a in arms]) for key in ("eef_pos", "eef_quat")]
        output_max, base = delta_conventions(meta)
        options = {"output_max": output_max, "base_rotation": base}
        goal = absolute_actions(*map(torch.from_numpy, (action, *poses)), **options).numpy()
        for arm, robot in enumerate(env.robots):
            part = robot.part_controllers["right"]
            origin = (robot.base_pos, Rotation.from_matrix(part.origin_ori))
            part.set_goal(action[7 * arm : 7 * arm + 6])
            position, rotation = part.goal_pos, part.goal_ori
            if frame == "base":
                position = origin[0] + origin[1].apply(position)
                rotation = origin[1].as_matrix() @ rotation
            np.testing.assert_allclose(goal[10 * arm : 10 * arm + 3], position, atol=1e-5)
            rows = rotation[:2].reshape(6)
            np.testing.assert_allclose(goal[10 * arm + 3 : 10 * arm + 9], rows, atol=1e-5)
