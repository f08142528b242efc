"""Operational-space control of one arm, as robosuite's ``OSC_POSE`` computes it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from warmprior.io.extras import require

__all__ = ["Arm", "check_supported", "compiled_torques"]


class Arm:
    """One robot's indices, controller and current goal in the world, ``goal_pos`` and ``goal_mat``."""

    def __init__(self, env: Any, robot: Any) -> None:
        composite = robot.composite_controller
        self.controller = controller = composite.part_controllers["right"]
        self.gripper = robot.gripper["right"]
        self.site = env.sim.model.site_name2id(controller.ref_name)
        composite.update_state()  # where the base is, for goals in its frame
        limits = env.sim.model._model.actuator_ctrlrange
        index = robot._ref_actuators_indexes_dict
        arm, self.fingers = np.array(index["right"]), np.array(index["right_gripper"])
        self.constants = (
            np.array(controller.qpos_index),
            np.array(controller.qvel_index),
            arm,
            limits[arm].copy(),
            np.array(controller.initial_joint, dtype=np.float64),
            np.array(controller.kp, dtype=np.float64),
            np.array(controller.kd, dtype=np.float64),
        )
        low, high = limits[self.fingers].T
        self.finger_middle, self.finger_range = (high + low) / 2, (high - low) / 2
        start = sum(r.action_dim for r in env.robots[: env.robots.index(robot)])
        self.split = {
            part: slice(start + first, start + last)
            for part, (first, last) in composite._action_split_indexes.items()
        }

    def set_goal(
        self, action: np.ndarray, positions: np.ndarray, matrices: np.ndarray, ctrl: np.ndarray
    ) -> None:
        """Resolve an action into a goal pose in the world and the fingers' command."""
        controller = self.controller
        if controller.new_update:
            # The pose is all that a goal depends on: spare the controller its full update.
            controller.ref_pos = positions[self.site].copy()
            controller.ref_ori_mat = matrices[self.site].copy()
            controller.new_update = False
        controller.set_goal(np.asarray(action[self.split["right"]], dtype=np.float64))
        controller.new_update = True  # env.step may follow
        goal_pos, goal_mat = controller.goal_pos, controller.goal_ori
        if controller.input_ref_frame == "base":
            goal_pos = controller.origin_pos + controller.origin_ori @ goal_pos
            goal_mat = controller.origin_ori @ goal_mat
        self.goal_pos = np.ascontiguousarray(goal_pos, dtype=np.float64)
        self.goal_mat = np.ascontiguousarray(goal_mat, dtype=np.float64)
        fingers = self.gripper.format_action(action[self.split["right_gripper"]])
        ctrl[self.fingers] = self.finger_middle + self.finger_range * fingers

    def remembered(
        self, jacp: np.ndarray, jacr: np.ndarray, mass: np.ndarray, qvel: np.ndarray, qpos: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """The pose of the grip site, and joints' velocities and positions, as measured during the reset.

        robosuite computes the first torques of an episode from these, although the joints have been put in
        place since; so does this loop.
        """
        controller = self.controller
        positions, columns = self.constants[:2]
        jacp[:, columns], jacr[:, columns] = controller.J_pos, controller.J_ori
        mass[np.ix_(columns, columns)] = controller.mass_matrix
        qvel, qpos = qvel.copy(), qpos.copy()
        qvel[columns], qpos[positions] = controller.joint_vel, controller.joint_pos
        return (controller.ref_pos, controller.ref_ori_mat), (qvel, qpos)


def check_supported(env: Any) -> None:
    """Refuse robots that are not of the kind that :class:`Arm` describes."""
    for robot in env.robots:
        composite = robot.composite_controller
        parts = composite.part_controllers
        controller = parts.get("right")
        supported = (
            composite.name == "BASIC"
            and set(parts) == {"right", "right_gripper"}
            and controller.name == "OSC_POSE"
            and controller.impedance_mode == "fixed"
            and controller.uncoupling
            and controller.interpolator_pos is None
            and controller.interpolator_ori is None
        )
        if not supported:
            raise ValueError(
                "the lean control loop supports one-handed arms with a fixed-impedance, uncoupled "
                "OSC_POSE controller without interpolation; use control_loop='robosuite' for "
                f"{type(composite).__name__} with {sorted(parts)}"
            )


@functools.cache
def compiled_torques() -> Callable[..., None]:
    """Return the compiled torques; compiled on first use, because robosuite is optional."""
    return require("robosuite.utils.numba", "sim").jit_decorator(_osc_torques)


def _osc_torques(
    pos, mat, jacp, jacr, mass_full, qvel, qpos, bias, ctrl,  # the simulation
    qpos_index, qvel_index, actuators, limits, rest, kp, kd,  # the arm
    goal_pos, goal_mat,
):  # fmt: skip
    """Write the clipped operational-space torques of one arm into ``ctrl``."""
    joints = qvel_index.shape[0]
    jac, mass = np.zeros((6, joints)), np.zeros((joints, joints))
    velocity, offset, gravity = np.zeros(joints), np.zeros(joints), np.zeros(joints)
    for i in range(joints):
        column = qvel_index[i]
        velocity[i], gravity[i] = qvel[column], bias[column]
        offset[i] = rest[i] - qpos[qpos_index[i]]
        for k in range(3):
            jac[k, i], jac[k + 3, i] = jacp[k, column], jacr[k, column]
        for j in range(joints):
            mass[i, j] = mass_full[column, qvel_index[j]]
    turn = np.zeros(3)  # half the sum of the cross products of present and wanted axes
    for k in range(3):
        turn[0] += 0.5 * (mat[1, k] * goal_mat[2, k] - mat[2, k] * goal_mat[1, k])
        turn[1] += 0.5 * (mat[2, k] * goal_mat[0, k] - mat[0, k] * goal_mat[2, k])
        turn[2] += 0.5 * (mat[0, k] * goal_mat[1, k] - mat[1, k] * goal_mat[0, k])
    twist = jac @ velocity
    force = kp[:3] * (goal_pos - pos) - kd[:3] * twist[:3]
    torque = kp[3:] * turn - kd[3:] * twist[3:]
    # robosuite takes pseudo-inverses, which differ from inverses at exact singularities only.
    inv_mass_jac = np.linalg.inv(mass) @ jac.T
    inertia_inv = jac @ inv_mass_jac
    wrench = np.zeros(6)
    wrench[:3] = np.linalg.inv(np.ascontiguousarray(inertia_inv[:3, :3])) @ force
    wrench[3:] = np.linalg.inv(np.ascontiguousarray(inertia_inv[3:, 3:])) @ torque
    # The posture's torques without their effect on the hand: N^T p, with N = 1 - M^-1 J^T L J.
    posture = mass @ (10.0 * offset - 2.0 * np.sqrt(10.0) * velocity)
    wrench -= np.linalg.inv(inertia_inv) @ (inv_mass_jac.T @ posture)
    torques = jac.T @ wrench + gravity + posture
    for i in range(joints):
        ctrl[actuators[i]] = min(max(torques[i], limits[i, 0]), limits[i, 1])
