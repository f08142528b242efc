"""Absolute joint targets, which most arms record: the scripted square, played by a joint controller.

python benchmarks/joint_targets.py --preset cpu --prior gaussian past preview past,correlation=0.5 --nfe 9 3 1
python benchmarks/joint_targets.py --style mh --demonstrations 300

A second arm follows each scripted demonstration, as a follower arm follows its leader: its targets are the
joint positions of the next step, tracked by robosuite's JOINT_POSITION controller. The second arm's motion is
recorded as a demonstration if it solves the task. Policies see the arm's joints, the gripper and the object.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robomimic import run
from tqdm import tqdm

from lab.demonstrations.data_options import DataOptions
from lab.options.command_line import script
from lab.options.options import with_parts
from lab.options.presets import PRESETS

if TYPE_CHECKING:
    import numpy as np

    from lab.demonstrations.episodes import Episode
    from warmprior.envs.control_loop import StepLoop
    from warmprior.tasks import Task

SQUARE, ARM = "square", "robot0_"
OBSERVATION = ["object", f"{ARM}joint_pos", f"{ARM}gripper_qpos"]
#: The largest stiffness that robosuite allows; the arm reaches a target within three control steps.
KP = 300


def joint_env_args() -> dict[str, Any]:
    """Return env_args of square whose actions are seven joint positions in radians and the gripper."""
    from warmprior.envs.simulator import task_env_args

    env_args = task_env_args(SQUARE)
    parts = env_args["env_kwargs"]["controller_configs"]["body_parts"]
    parts["right"] = {
        "type": "JOINT_POSITION",
        "input_type": "absolute",
        "kp": KP,
        "interpolation": None,
        "gripper": {"type": "GRIP"},
    }
    return env_args


def followed(path: Path, loop: StepLoop) -> Iterator[Episode]:
    """Yield the follower's episode for each demonstration in a file, if it solves the task."""
    import numpy as np

    from warmprior.data.formats.hdf5 import open_robomimic, selected_demos

    with open_robomimic(path) as file:
        names = selected_demos(file, None)
        for index, name in enumerate(tqdm(names, "joint targets", unit="demo")):
            demo = file[f"data/{name}"]
            joints = demo[f"next_obs/{ARM}joint_pos"][()]
            # The last target is held for ten steps, because the arm lags behind.
            targets = np.concatenate([joints, np.repeat(joints[-1:], 10, 0)])
            fingers = demo["actions"][:, -1:]
            actions = np.concatenate([targets, np.pad(fingers, ((0, 10), (0, 0)), "edge")], -1)
            episode = follow(loop, demo["states"][0], actions)
            if episode.success:
                episode.seed, episode.operator = index, int(demo.attrs["operator"])
                yield episode


def follow(loop: StepLoop, state: np.ndarray, actions: np.ndarray) -> Episode:
    """Play targets from a state until the task is solved for six steps."""
    from lab.demonstrations.episodes import Recorder

    loop.reset(0)
    recorder = Recorder(loop)
    recorder.begin(loop.set_state(state))
    for robot in loop.env.robots:
        robot.composite_controller.reset()
    for action in actions:
        recorder.step(action)
        if sum(recorder.rewards[-6:]) == 6:
            break
    return recorder.episode(seed=0, success=any(recorder.rewards))


def demonstrations(style: str, count: int) -> Path:
    """Return the file of the follower's demonstrations; record it if it does not exist."""
    from lab.demonstrations.episodes import write_robomimic
    from lab.demonstrations.scripted.generate import generate_demonstrations
    from warmprior.envs.control_loop import StepLoop
    from warmprior.envs.simulator import make_simulator

    source = generate_demonstrations(SQUARE, style, count)
    path = source.with_name(f"{source.stem}_joint_targets.hdf5")
    if not path.exists():
        env = make_simulator(joint_env_args())
        model = str(env.sim.model.get_xml())
        episodes = followed(source, StepLoop(env, OBSERVATION))
        write_robomimic(path, episodes, env_args=joint_env_args(), model_file=model)
        env.close()
    return path


def task(options: DataOptions) -> Task:
    """Return the task: the follower's demonstrations, and square under the same controller."""
    from warmprior.data import open_demonstrations
    from warmprior.tasks import Play, Task

    options.check_only("task", "style", "demonstrations", "horizon")
    style = options.style[0]
    if style not in ("ph", "mh"):
        raise ValueError(f"--style {style} has no scripted demonstrations: choose ph or mh")
    path = demonstrations(style, options.count(style))
    return Task(
        open_demonstrations(path, style=style),
        observations=OBSERVATION,
        joints=f"{ARM}joint_pos",
        play=Play(horizon=options.horizon),
    )


PLAYED = {"data": {"task": ("joint_targets:task",), "actions": "delta"}}


@script("joint_targets.py", together=True)
def main(argv: list[str] | None) -> None:
    presets = {name: with_parts(preset, **PLAYED) for name, preset in PRESETS.items()}
    run(argv, presets, "joint_targets", __doc__)


if __name__ == "__main__":
    sys.exit(main())
