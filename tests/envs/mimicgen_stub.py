"""A package with the interface of MimicGen's: written for robosuite 1.4, registered when imported."""

from pathlib import Path

TOP = """
print("imported")
try:
    from mimicgen.envs.robosuite.stack import *
    from mimicgen.envs.robosuite.coffee import *
    from mimicgen.envs.robosuite.threading import *
except ImportError as error:
    print("WARNING:", error)
"""

STACK = """
from robosuite.environments.manipulation.single_arm_env import SingleArmEnv
from robosuite.environments.manipulation.stack import Stack

class Stack_D0(Stack, SingleArmEnv):
    def __init__(self, **kwargs):
        Stack.__init__(self, **kwargs)
"""

COFFEE = """
import numpy as np
from robosuite.environments.manipulation.single_arm_env import SingleArmEnv
from robosuite.models.arenas import TableArena
from robosuite.models.tasks import ManipulationTask
from robosuite.utils.observables import Observable, sensor

class Coffee_D0(SingleArmEnv):
    WIDTH = 57

    def __init__(
        self, robots, controller_configs=None, use_camera_obs=True, use_object_obs=True,
        reward_shaping=False, has_renderer=False, has_offscreen_renderer=True, control_freq=20,
        horizon=1000, ignore_done=False, hard_reset=True, camera_heights=256, camera_widths=256,
        camera_depths=False, renderer="mujoco",
    ):
        super().__init__(
            robots=robots, controller_configs=controller_configs, mount_types="default",
            use_camera_obs=use_camera_obs, has_renderer=has_renderer,
            has_offscreen_renderer=has_offscreen_renderer, control_freq=control_freq,
            horizon=horizon, ignore_done=ignore_done, hard_reset=hard_reset, renderer=renderer,
        )

    def _load_model(self):
        super()._load_model()
        robot = self.robots[0].robot_model
        robot.set_base_xpos(robot.base_xpos_offset["table"](0.8))
        arena = TableArena()
        arena.set_origin([0, 0, 0])
        self.model = ManipulationTask(mujoco_arena=arena, mujoco_robots=[robot])

    def _setup_observables(self):
        observables = super()._setup_observables()

        @sensor(modality="object")
        def place(obs_cache):
            site = self.sim.model.site_name2id(self.robots[0].controller.eef_name)
            return np.resize(self.sim.data.site_xpos[site], self.WIDTH)

        observables["place"] = Observable(name="place", sensor=place, sampling_rate=self.control_freq)
        return observables

    def reward(self, action=None):
        return float(self._check_success())

    def _check_success(self):
        return False
"""

THREADING = """
from mimicgen.envs.robosuite.coffee import Coffee_D0

class Threading_D0(Coffee_D0):
    WIDTH = 28
"""


def write_mimicgen(folder: Path, **modules: str) -> None:
    """Write the package into a folder on Python's path, some modules with other contents than above."""
    tasks = folder / "mimicgen" / "envs" / "robosuite"
    tasks.mkdir(parents=True)
    for package in (tasks, tasks.parent):
        (package / "__init__.py").touch()
    (tasks.parents[1] / "__init__.py").write_text(TOP)
    for name, text in ({"stack": STACK, "coffee": COFFEE, "threading": THREADING} | modules).items():
        (tasks / f"{name}.py").write_text(text)
