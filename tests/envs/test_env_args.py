from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from tests.data.synthetic import env_args_14, env_args_15
from warmprior.envs.env_args import (
    absolute_actions,
    absolute_to_env_action,
    delta_conventions,
    modernize_env_args,
)
from warmprior.rotation import (
    matrix_to_rotation_6d,
    matrix_to_rotvec,
    quaternion_to_matrix,
    rotation_6d_to_matrix,
    rotation_6d_to_rotvec,
    rotvec_to_matrix,
)

TASKS = ("lift", "can", "square", "transport")
# The hand body seen from the grip site, as scipy writes it.
SITE = Rotation.from_euler("z", -90, degrees=True)
finite = st.floats(-4, 4, allow_nan=False, width=64)


def _quaternions(n, seed=0):
    return Rotation.random(n, random_state=seed).as_quat()


# ---------------------------------------------------------------------------- rotations
@settings(deadline=None, max_examples=200)
@given(arrays(np.float64, (3,), elements=finite))
def test_rotvec_round_trip_against_scipy(rotvec):
    reference = Rotation.from_rotvec(rotvec)
    matrix = rotvec_to_matrix(torch.from_numpy(rotvec))
    np.testing.assert_allclose(matrix, reference.as_matrix(), atol=1e-12)
    back = matrix_to_rotvec(matrix).numpy()
    assert np.linalg.norm(back) <= np.pi + 1e-9
    np.testing.assert_allclose(Rotation.from_rotvec(back).as_matrix(), reference.as_matrix(), atol=1e-9)
    again = rotation_6d_to_rotvec(matrix_to_rotation_6d(matrix)).numpy()
    np.testing.assert_allclose(Rotation.from_rotvec(again).as_matrix(), reference.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.0, -0.8]]]))
def test_rotvec_survives_no_turn_and_half_turns(angle, axis):
    rotvec = torch.from_numpy(angle * axis)
    back = matrix_to_rotvec(rotvec_to_matrix(rotvec)).numpy()
    np.testing.assert_allclose(
        Rotation.from_rotvec(back).as_matrix(),
        Rotation.from_rotvec(angle * axis).as_matrix(),
        atol=1e-12,
    )


def test_quaternions_against_scipy():
    quaternions = _quaternions(50)
    expected = Rotation.from_quat(quaternions).as_matrix()
    np.testing.assert_allclose(quaternion_to_matrix(torch.from_numpy(quaternions)), expected)
    # Neither sign nor length of a quaternion means anything.
    np.testing.assert_allclose(quaternion_to_matrix(torch.from_numpy(-3 * quaternions)), expected, atol=1e-12)


@settings(deadline=None, max_examples=100)
@given(arrays(np.float64, (6,), elements=finite))
def test_gram_schmidt_gives_rotations(numbers):
    first, second = numbers[:3], numbers[3:]
    if np.linalg.norm(np.cross(first, second)) < 1e-2:  # parallel rows mean nothing
        return
    matrix = rotation_6d_to_matrix(torch.from_numpy(numbers)).numpy()
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(matrix[0] * np.linalg.norm(first), first, atol=1e-9)
    assert abs(np.dot(matrix[2], second)) < 1e-9 and np.dot(matrix[1], second) > 0


@pytest.mark.parametrize(
    ("function", "shape"),
    [
        (quaternion_to_matrix, (2, 3)),
        (rotvec_to_matrix, (4,)),
        (matrix_to_rotvec, (3,)),
        (matrix_to_rotation_6d, (3, 2)),
        (rotation_6d_to_matrix, (5,)),
    ],
)
def test_rotations_refuse_wrong_shapes(function, shape):
    with pytest.raises(ValueError, match="got"):
        function(torch.zeros(shape))


# ---------------------------------------------------------------------------- absolute actions
def _reference(actions, position, quaternion, base=None):
    """One arm, with scipy: [N, 7] deltas to positions, rotations and grippers."""
    base = base or Rotation.identity()
    delta = np.clip(actions[:, :6], -1, 1)
    goal = position + base.apply(0.05 * delta[:, :3])
    turn = base * Rotation.from_rotvec(0.5 * delta[:, 3:]) * base.inv()
    return goal, turn * Rotation.from_quat(quaternion) * SITE, actions[:, 6:]


@pytest.mark.parametrize("arms", [1, 2])
def test_absolute_actions_against_scipy(arms):
    rng = np.random.default_rng(arms)
    n = 40
    actions = rng.uniform(-1.5, 1.5, (n, 7 * arms))  # beyond the limits: the controller clips
    position = rng.normal(size=(n, 3 * arms))
    quaternion = np.concatenate([_quaternions(n, seed) for seed in range(arms)], -1)
    out = absolute_actions(*map(torch.from_numpy, (actions, position, quaternion)))
    assert out.shape == (n, 10 * arms)
    env = absolute_to_env_action(out).numpy()
    assert env.shape == (n, 7 * arms)
    for arm in range(arms):
        goal, rotation, gripper = _reference(
            actions[:, 7 * arm : 7 * arm + 7],
            position[:, 3 * arm : 3 * arm + 3],
            quaternion[:, 4 * arm : 4 * arm + 4],
        )
        rows = rotation.as_matrix()[:, :2].reshape(n, 6)
        expected = np.concatenate([goal, rows, gripper], -1)
        np.testing.assert_allclose(out[:, 10 * arm : 10 * arm + 10], expected, atol=1e-9)
        np.testing.assert_allclose(env[:, 7 * arm : 7 * arm + 3], goal, atol=1e-9)
        np.testing.assert_allclose(
            Rotation.from_rotvec(env[:, 7 * arm + 3 : 7 * arm + 6]).as_matrix(),
            rotation.as_matrix(),
            atol=1e-9,
        )
        np.testing.assert_allclose(env[:, 7 * arm + 6 : 7 * arm + 7], gripper)


def test_absolute_actions_turn_deltas_out_of_the_base_frame():
    rng = np.random.default_rng(3)
    actions, position = rng.uniform(-1, 1, (8, 14)), rng.normal(size=(8, 6))
    quaternion = np.concatenate([_quaternions(8, 1), _quaternions(8, 2)], -1)
    output_max, base = delta_conventions(env_args_15("transport", frame="base"))
    out = absolute_actions(
        *map(torch.from_numpy, (actions, position, quaternion)),
        output_max=output_max,
        base_rotation=base,
    )
    for arm, degrees in enumerate((90, -90)):
        goal, rotation, _ = _reference(
            actions[:, 7 * arm : 7 * arm + 7],
            position[:, 3 * arm : 3 * arm + 3],
            quaternion[:, 4 * arm : 4 * arm + 4],
            Rotation.from_euler("z", degrees, degrees=True),
        )
        np.testing.assert_allclose(out[:, 10 * arm : 10 * arm + 3], goal, atol=1e-9)
        rows = rotation.as_matrix()[:, :2].reshape(8, 6)
        np.testing.assert_allclose(out[:, 10 * arm + 3 : 10 * arm + 9], rows, atol=1e-9)


def test_absolute_actions_keep_dtype_and_batch_shape():
    out = absolute_actions(torch.zeros(2, 3, 7), torch.zeros(2, 3, 3), torch.ones(2, 3, 4))
    assert out.shape == (2, 3, 10) and out.dtype == torch.float32
    assert absolute_to_env_action(out).shape == (2, 3, 7)


def test_absolute_actions_do_not_depend_on_the_sign_of_a_quaternion():
    actions, quaternion = torch.rand(20, 7), torch.from_numpy(_quaternions(20, 0)).float()
    position = torch.zeros(20, 3)
    torch.testing.assert_close(
        absolute_actions(actions, position, quaternion),
        absolute_actions(actions, position, -quaternion),
    )


@pytest.mark.parametrize("shapes", [((8,), (3,), (4,)), ((7,), (6,), (4,)), ((14,), (6,), (4,))])
def test_absolute_actions_refuse_wrong_widths(shapes):
    with pytest.raises(ValueError, match="column"):
        absolute_actions(*map(torch.zeros, shapes))


# ---------------------------------------------------------------------------- env_args
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("make", [env_args_14, env_args_15])
@pytest.mark.parametrize("absolute", [False, True])
def test_modernize_is_pure_and_idempotent(task, make, absolute):
    before = make(task)
    kept = copy.deepcopy(before)
    once = modernize_env_args(before, absolute)
    assert before == kept
    assert modernize_env_args(once) == once
    assert modernize_env_args(once, absolute) == once
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


def test_modernize_keeps_what_a_new_file_says():
    meta = env_args_15("transport", frame="base")
    new = modernize_env_args(meta)
    del meta["env_kwargs"]["render_gpu_device_id"]
    assert new == meta


def test_modernize_fills_in_the_default_frame_and_flattens_arms():
    meta = env_args_15("lift")
    parts = meta["env_kwargs"]["controller_configs"]["body_parts"]
    del parts["right"]["input_ref_frame"]
    meta["env_kwargs"]["controller_configs"]["body_parts"] = {"arms": parts, "base": {"type": "X"}}
    new = modernize_env_args(meta)["env_kwargs"]["controller_configs"]["body_parts"]
    assert new["right"]["input_ref_frame"] == "base" and new["base"] == {"type": "X"}
    assert "arms" not in new


def test_modernize_control_delta_false_means_absolute():
    meta = env_args_14("lift")
    meta["env_kwargs"]["controller_configs"]["control_delta"] = False
    new = modernize_env_args(meta)["env_kwargs"]["controller_configs"]
    assert new["body_parts"]["right"]["input_type"] == "absolute"
    with pytest.raises(ValueError, match="absolute_actions=False"):
        delta_conventions(meta)


def test_modernize_list_of_controllers():
    meta = env_args_14("transport")
    controllers = meta["env_kwargs"]["controller_configs"]
    meta["env_kwargs"]["controller_configs"] = [controllers, copy.deepcopy(controllers)]
    new = modernize_env_args(meta, absolute=True)["env_kwargs"]["controller_configs"]
    assert [c["body_parts"]["right"]["input_type"] for c in new] == ["absolute"] * 2


def test_modernize_leaves_lite_physics_to_mimicgen():
    meta = env_args_14("square") | {"env_name": "Square_D1"}
    assert "lite_physics" not in modernize_env_args(meta)["env_kwargs"]


@pytest.mark.parametrize("missing", ["env_name", "env_kwargs"])
def test_modernize_refuses_incomplete(missing):
    meta = env_args_14("lift")
    del meta[missing]
    with pytest.raises(ValueError, match=missing):
        modernize_env_args(meta)


def test_absolute_needs_a_pose_controller():
    meta = env_args_14("lift")
    meta["env_kwargs"]["controller_configs"]["type"] = "JOINT_POSITION"
    with pytest.raises(ValueError, match="JOINT_POSITION"):
        modernize_env_args(meta, absolute=True)
    del meta["env_kwargs"]["controller_configs"]
    with pytest.raises(ValueError, match="controller_configs"):
        modernize_env_args(meta, absolute=True)


def test_delta_conventions_read_the_controller():
    meta = env_args_14("square")
    meta["env_kwargs"]["controller_configs"] |= {
        "output_max": [0.1] * 3 + [0.3] * 3,
        "output_min": [-0.1] * 3 + [-0.3] * 3,
    }
    output_max, base = delta_conventions(meta)
    assert output_max.tolist() == [0.1] * 3 + [0.3] * 3
    torch.testing.assert_close(base, torch.eye(3, dtype=torch.float64)[None])
    meta["env_kwargs"]["controller_configs"]["output_min"] = [-0.2] * 6
    with pytest.raises(ValueError, match="symmetric"):
        delta_conventions(meta)


@pytest.mark.parametrize("task", TASKS)
def test_robosuite_accepts_converted_files(task):
    suite = pytest.importorskip("robosuite")
    meta = modernize_env_args(env_args_14(task))
    env = suite.make(meta["env_name"], **meta["env_kwargs"])
    try:
        arms = env_args_14(task)["env_kwargs"]["robots"]
        assert env.action_dim == 7 * len(arms)
        for robot in env.robots:
            part = robot.part_controllers["right"]
            assert part.input_ref_frame == "world" and part.input_type == "delta"
            assert np.allclose(part.kd, 2 * np.sqrt(150))
    finally:
        env.close()


@pytest.mark.parametrize("frame", ["world", "base"])
@pytest.mark.parametrize("task", ["lift", "transport"])
def test_absolute_goal_is_the_controllers_own_goal(task, frame):
    """The controller, fed with a delta, must aim at the pose that was computed without it."""
    suite = pytest.importorskip("robosuite")
    meta = env_args_15(task, frame)
    env = suite.make(meta["env_name"], **modernize_env_args(meta)["env_kwargs"])
    try:
        np.random.seed(0)
        obs = env.reset()
        rng = np.random.default_rng(0)
        action = rng.uniform(-1, 1, env.action_dim)
        arms = range(len(env.robots))
        output_max, base = delta_conventions(meta)
        goal = absolute_actions(
            torch.from_numpy(action),
            torch.from_numpy(np.concatenate([obs[f"robot{a}_eef_pos"] for a in arms])),
            torch.from_numpy(np.concatenate([obs[f"robot{a}_eef_quat"] for a in arms])),
            output_max=output_max,
            base_rotation=base,
        ).numpy()
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
    finally:
        env.close()
