"""Push-T on human demonstrations: a task outside of robosuite, in one file.

python benchmarks/pusht.py                                         # demonstrations from the hub
python benchmarks/pusht.py --dataset lerobot:FOLDER --demonstrations 25
python benchmarks/pusht.py --task pusht:relative                   # actions are offsets from the agent
python benchmarks/sigma.py --task pusht:task --dataset lerobot:FOLDER

It needs two extras (pip install -e '.[sim,pusht]'). The `coverage` of an episode is the largest share of the
goal that the block covered; above 0.95 the episode is solved.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING, Any

from robomimic import run

from lab.demonstrations.data_options import DataOptions
from lab.options.command_line import script
from lab.options.options import with_parts
from lab.options.presets import PRESETS
from warmprior.io.extras import require

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from warmprior.tasks import Task

SIDE = 512.0  # side of the field in pixels
OBSERVATION = ["observation.state", "observation.environment_state"]  # the agent, the block's corners


def make_env(relative: bool = False) -> EnvBase:
    """Make the environment in raw units: actions are target positions of the agent, in pixels."""
    import numpy as np

    from warmprior.envs import gym_env

    require("gym_pusht", "pusht")
    import gymnasium

    name, observed = "gym_pusht/PushT-v0", "environment_state_agent_pos"
    env: Any = gymnasium.make(name, obs_type=observed, render_mode="rgb_array")
    if relative:
        offsets, base = gymnasium.spaces.Box(-SIDE, SIDE, (2,)), env.unwrapped
        env = gymnasium.wrappers.TransformAction(env, lambda a: a + np.array(base.agent.position), offsets)
    keys = ["agent_pos", "environment_state"]
    return gym_env(env, success="is_success", measures=["coverage"], observation_keys=keys)


def task(options: DataOptions, relative: bool = False) -> Task:
    """Return the task: human demonstrations, and the environment that policies are played in."""
    from warmprior.data import demonstrations_of, open_demonstrations
    from warmprior.tasks import Play, Task

    options.check_only("task", "dataset", "demonstrations")
    place = options.dataset or "lerobot:lerobot/pusht_keypoints"
    steps = open_demonstrations(place, demos=options.first("human")).steps(OBSERVATION)
    if relative:
        steps["action"] = steps["action"] - steps["observation"][:, :2]
    play = Play(partial(make_env, relative), measures={"coverage": "max"}, video_rate=10)
    return Task(demonstrations_of(steps, "pusht", style="relative" if relative else "human"), play=play)


def relative(options: DataOptions) -> Task:
    """Return the task with actions as offsets from the agent's position: `--task pusht:relative`."""
    return task(options, relative=True)


# All human demonstrations are used unless --demonstrations says otherwise. Their 25,650 steps need more than
# the usual 10,000 iterations: at one step the Gaussian source scores 0.59 after 10,000, 0.79 after 22,500 and
# 0.88 after 45,000.
HUMAN = {"data": {"task": ("pusht:task",), "demonstrations": (), "actions": "delta"}}
LONGER = {"quick": {"iterations": 22_500}, "cpu": {"iterations": 45_000}}


@script("pusht.py", together=True)
def main(argv: list[str] | None) -> None:
    presets = {name: with_parts(p, **HUMAN, training=LONGER.get(name, {})) for name, p in PRESETS.items()}
    run(argv, presets, "pusht", __doc__)


if __name__ == "__main__":
    sys.exit(main())
