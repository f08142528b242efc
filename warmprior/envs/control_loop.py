"""Two loops for a control step of a robosuite environment: robosuite's own and a lean one.

robosuite spends two thirds of ``env.step`` in the Python of its controllers. :class:`ControlLoop` computes
the same torques in one compiled function and observes once, at the end. Robot positions agree with
``env.step`` to rounding over ten control steps; contacts amplify the rounding after that.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, override

import numpy as np

from warmprior.checks import check_choice, check_shape
from warmprior.envs.simulator import isolated_numpy_seed
from warmprior.io.extras import require


class Arm:
    """The indices, controller and current goal in the world, ``goal_pos`` and ``goal_mat``, of a robot."""

    def __init__(self, env: Any, robot: Any) -> None:
        composite = robot.composite_controller
        self.controller = controller = composite.part_controllers["right"]
        self.gripper = robot.gripper["right"]
        self.site = env.sim.model.site_name2id(controller.ref_name)
        composite.update_state()  # where the base is, for goals in its frame
        limits = env.sim.model._model.actuator_ctrlrange
        index = robot._ref_actuators_indexes_dict
        arm, self.fingers = np.array(index["right"]), np.array(index["right_gripper"], dtype=int)
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
            # A goal depends only on the pose, so the controller's full update is not needed.
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
        """Return the pose of the grip site, and the joints' velocities and positions, measured at the reset.

        This reproduces robosuite's behaviour of computing the first torques from stale reset measurements.
        """
        controller = self.controller
        positions, columns = self.constants[:2]
        jacp[:, columns], jacr[:, columns] = controller.J_pos, controller.J_ori
        mass[np.ix_(columns, columns)] = controller.mass_matrix
        qvel, qpos = qvel.copy(), qpos.copy()
        qvel[columns], qpos[positions] = controller.joint_vel, controller.joint_pos
        return (controller.ref_pos, controller.ref_ori_mat), (qvel, qpos)


def is_plain(env: Any) -> bool:
    """Return True if :class:`ControlLoop` can step an environment: robosuite's own, with plain arms.

    A wrapper or a subclass that changes a step would be bypassed, and so would sensors with a delay or a rate
    of their own.
    """
    base = require("robosuite.environments.base", "sim").MujocoEnv
    if not (isinstance(env, base) and all(map(is_plain_arm, env.robots))):
        return False
    steps = [getattr(type(env), name).__module__ for name in ("step", "_pre_action", "_post_action")]
    no_delay = require("robosuite.utils.observables", "sim").NO_DELAY
    return {name.partition(".")[0] for name in steps} <= {"robosuite", "mimicgen"} and all(
        sensor._delayer is no_delay and sensor._sampling_timestep <= env.control_timestep + 1e-9
        for sensor in env._observables.values()
    )


def is_plain_arm(robot: Any) -> bool:
    """Return True if a robot is a single OSC_POSE arm on a fixed base, with a gripper."""
    composite = robot.composite_controller
    controller = composite.part_controllers.get("right")
    return bool(
        composite.name == "BASIC"
        and set(composite.part_controllers) == {"right", "right_gripper"}
        and controller.name == "OSC_POSE"
        and controller.impedance_mode == "fixed"
        and controller.uncoupling
        and controller.interpolator_pos is None
        and controller.interpolator_ori is None
        and getattr(composite.part_controllers["right_gripper"], "use_action_scaling", False)
        and _has_fixed_center(controller)
    )


def _has_fixed_center(controller: Any) -> bool:
    """Return True if the site whose velocity robosuite subtracts cannot move, as that of IIWA does."""
    model = controller.sim.model
    site = model.site_name2id(f"{controller.naming_prefix}{controller.part_name}_center")
    return bool(model._model.body_weldid[model._model.site_bodyid[site]] == 0)


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


Observations = dict[str, np.ndarray]


class StepLoop:
    """A loop that steps a robosuite environment with ``env.step`` and reads robomimic's observations.

    The environment's time limit is switched off, because the wrapper ends episodes. Only the observations in
    ``keys``, robomimic's names, are computed, all by default. Raises ValueError if a name is unknown.
    """

    def __init__(self, env: Any, keys: Sequence[str] | None = None) -> None:
        self.env = env
        getattr(env, "unwrapped", env).ignore_done = True
        self._select(keys)
        self._bind()

    def _select(self, keys: Sequence[str] | None) -> None:
        observables = self.env._observables
        for name, observable in observables.items():
            # Inactive observables (grip poses) and grippers' poses stay enabled: object sensors read them.
            read = observable.modality == "object" or name.endswith(("eef_pos", "eef_quat"))
            if keys is not None and observable.is_active() and not read:
                self.env.modify_observable(name, "enabled", name in keys)
        self._names = {
            name: "object" if name == "object-state" else name
            for name in self.env._get_observations(force_update=True)
            if name == "object-state" or observables.get(name) is not None
        }
        if keys is not None:
            for key in set(keys) - set(self._names.values()):
                check_choice("observation", key, sorted({"object", *observables} - {key}))
            self._names = {name: key for name, key in self._names.items() if key in keys}

    def _bind(self) -> None:
        """Look up the objects that a reset may have replaced."""
        sim = self.env.sim
        self._model, self._data = sim.model._model, sim.data._data
        self._bodies: dict[str, int] = {}
        arms = [robot.composite_controller.part_controllers["right"] for robot in self.env.robots]
        self._sites = [sim.model.site_name2id(controller.ref_name) for controller in arms]

    def reset(self, seed: int) -> Observations:
        """Start the episode of a seed, without changing the global generators."""
        with isolated_numpy_seed(seed):
            self.env.reset()
        self._bind()
        return self._settled_observations()

    def set_state(self, state: np.ndarray) -> Observations:
        """Restore a recorded state, ``[1 + nq + nv]`` as from :meth:`state`, and return its observations.

        The state does not include the gripper's command and the solver's starting point, so the continuation
        is close to the recorded one but not identical.
        """
        check_shape("state", state, (1 + self._model.nq + self._model.nv,))
        self.env.sim.set_state_from_flattened(state)
        self.env.sim.forward()
        return self._settled_observations()

    def _settled_observations(self) -> Observations:
        # Sensors of objects relative to the gripper read poses that the previous update cached.
        self.env._update_observables(force=True)
        return self.observations(refresh=True)

    def step(self, action: np.ndarray) -> tuple[Observations, bool]:
        """Advance one control step (50 ms); return observations, and True if the task is solved."""
        self.env.step(action)
        return self.observations(refresh=False), bool(self.env._check_success())

    def observations(self, refresh: bool = True) -> Observations:
        """Return observations, float64 under robomimic's names; those of the last step unless ``refresh``."""
        observations = self.env._get_observations(force_update=refresh)
        return {key: np.atleast_1d(observations[name]) for name, key in self._names.items()}

    def state(self) -> np.ndarray:
        """Return the simulator's state: time, positions and velocities, ``[1 + nq + nv]``."""
        return np.concatenate(([self._data.time], self._data.qpos, self._data.qvel))

    def eef(self, arm: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the position ``[3]`` (metres) and rotation ``[3, 3]`` of an arm's grip site."""
        site = self._sites[arm]
        return self._data.site_xpos[site].copy(), self._data.site_xmat[site].reshape(3, 3).copy()

    def body(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the position ``[3]`` (metres) and rotation ``[3, 3]`` of a body of the model."""
        if name not in self._bodies:
            self._bodies[name] = self.env.sim.model.body_name2id(name)
        body = self._bodies[name]
        return self._data.xpos[body].copy(), self._data.xmat[body].reshape(3, 3).copy()


class ControlLoop(StepLoop):
    """A loop that steps a robosuite environment as ``env.step`` does, about 2.5 times faster.

    It supports fixed-base, one-handed arms under ``OSC_POSE`` with fixed impedance, uncoupled position and
    orientation and no interpolation, as in robomimic and MimicGen. Raises ValueError for any other robot or
    controller, and for environments with a step or sensors of their own, see :func:`is_plain`.
    """

    def __init__(self, env: Any, keys: Sequence[str] | None = None) -> None:
        if not is_plain(env):
            controllers = [type(robot.composite_controller).__name__ for robot in env.robots]
            raise ValueError(
                "the lean loop needs plain OSC_POSE arms, and robosuite's own step and sensors: use "
                f"control_loop='robosuite' for {type(env).__name__} with {controllers}"
            )
        self._mujoco = require("mujoco", "sim")
        self._torques = compiled_torques()
        super().__init__(env, keys)

    def _bind(self) -> None:
        super()._bind()
        self._arms = [Arm(self.env, robot) for robot in self.env.robots]
        nv = self._model.nv
        self._mass, self._jacp, self._jacr = (np.zeros((nv, nv)), np.zeros((3, nv)), np.zeros((3, nv)))
        self._substeps = int(self.env.control_timestep / self.env.model_timestep)
        data = self._data
        self._site_pos, self._site_mat = data.site_xpos, data.site_xmat.reshape(-1, 3, 3)

    @override
    def step(self, action: np.ndarray) -> tuple[Observations, bool]:
        env, mujoco, model, data = self.env, self._mujoco, self._model, self._data
        check_shape("action", action, (env.action_dim,))
        for substep in range(self._substeps):
            mujoco.mj_step1(model, data)
            mujoco.mj_fullM(model, self._mass, data.qM)
            for arm in self._arms:
                remembered = substep == 0 and not arm.controller.new_update
                if substep == 0:
                    arm.set_goal(action, self._site_pos, self._site_mat, data.ctrl)
                mujoco.mj_jacSite(model, data, self._jacp, self._jacr, arm.site)
                pose = self._site_pos[arm.site], self._site_mat[arm.site]
                motion = data.qvel, data.qpos
                if remembered:
                    pose, motion = arm.remembered(self._jacp, self._jacr, self._mass, *motion)
                self._torques(
                    *pose,
                    self._jacp,
                    self._jacr,
                    self._mass,
                    *motion,
                    data.qfrc_bias,
                    data.ctrl,
                    *arm.constants,
                    arm.goal_pos,
                    arm.goal_mat,
                )
            mujoco.mj_step2(model, data)
        env.timestep += 1
        env.cur_time += env.control_timestep
        success = bool(env._check_success())
        # Poses belong to the last substep's start until the kinematics are brought up to date.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return self.observations(refresh=True), success
