"""The manipulation tasks: one table that the readers, experts, environments and benchmarks share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from warmprior.checks import check_choice

#: Styles of demonstrations: robomimic's one or six operators, MimicGen's ten human ones and their variations.
STYLES = ("ph", "mh", "source", "core")

_ARM_WIDTHS = {"eef_pos": 3, "eef_quat": 4, "gripper_qpos": 2}


def low_dim_keys(arms: int) -> tuple[str, ...]:
    """Return the observations that make up the state: ``object``, then each arm's pose and gripper."""
    return ("object", *(f"robot{i}_{key}" for i in range(arms) for key in _ARM_WIDTHS))


@dataclass(frozen=True)
class TaskSpec:
    """The facts about a task.

    Attributes:
        name: the short name used by robomimic or MimicGen and by this library's options.
        env_name: the robosuite environment.
        arms: the number of Panda arms (1 or 2).
        horizon_ph: time limit in control steps, except for six-operator data.
        horizon_mh: time limit in control steps for six-operator (``mh``) data.
        object_dim: width of the ``object`` observation.
        cameras: the cameras of robomimic's image files, third person first.

    Examples:
        >>> from warmprior.envs import TaskSpec
        >>> door = TaskSpec("door", "Door", arms=1, horizon_ph=300, horizon_mh=500, object_dim=22)
        >>> door.observation_dim, door.action_dim, door.horizon("mh"), door.low_dim_widths["object"]
        (31, 7, 500, 22)
    """

    name: str
    env_name: str
    arms: int
    horizon_ph: int
    horizon_mh: int
    object_dim: int
    cameras: tuple[str, ...] = ("agentview", "robot0_eye_in_hand")

    @property
    def low_dim_keys(self) -> tuple[str, ...]:
        """The observation keys whose concatenation is the state, ``object`` first, then each arm."""
        return low_dim_keys(self.arms)

    @property
    def low_dim_widths(self) -> dict[str, int]:
        """The width of each of :attr:`low_dim_keys`."""
        widths = [self.object_dim, *[*_ARM_WIDTHS.values()] * self.arms]
        return dict(zip(self.low_dim_keys, widths, strict=True))

    @property
    def observation_dim(self) -> int:
        """The width of the concatenated state."""
        return sum(self.low_dim_widths.values())

    @property
    def action_dim(self) -> int:
        """The width of the action, which is a 6-d pose delta and a gripper command per arm."""
        return 7 * self.arms

    def horizon(self, style: str) -> int:
        """Return the time limit in control steps for data of a style, one of :data:`STYLES`."""
        return self.horizon_mh if style == "mh" else self.horizon_ph


TASKS: dict[str, TaskSpec] = {
    spec.name: spec
    for spec in (
        TaskSpec("lift", "Lift", 1, 400, 500, 10),
        TaskSpec("can", "PickPlaceCan", 1, 400, 500, 14),
        TaskSpec("square", "NutAssemblySquare", 1, 400, 500, 14),
        TaskSpec("stack", "Stack", 1, 400, 500, 23),
        TaskSpec(
            "transport",
            "TwoArmTransport",
            2,
            700,
            1100,
            41,
            cameras=("shouldercamera0", "shouldercamera1", "robot0_eye_in_hand", "robot1_eye_in_hand"),
        ),
        TaskSpec("tool_hang", "ToolHang", 1, 700, 700, 44, cameras=("sideview", "robot0_eye_in_hand")),
        *(
            TaskSpec(name, env_name, 1, 400, 400, width)
            for name, env_name, width in (
                ("stack_d0", "Stack_D0", 23),
                ("coffee_d0", "Coffee_D0", 57),
                ("threading_d0", "Threading_D0", 28),
            )
        ),
    )
}


def get_task(name: str) -> TaskSpec:
    """Return a task by its short name, a key of :data:`TASKS`; raise ValueError if there is none.

    Examples:
        >>> from warmprior.envs import get_task
        >>> get_task("square").observation_dim
        23
    """
    check_choice("task", name, TASKS)
    return TASKS[name]


def task_of_env(env_args: Mapping[str, Any]) -> TaskSpec | None:
    """Return the task of :data:`TASKS` that uses an environment, or ``None``."""
    return next((task for task in TASKS.values() if task.env_name == env_args["env_name"]), None)
