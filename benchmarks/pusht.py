"""Push-T on human demonstrations: a task outside of robosuite, in one file.

python benchmarks/pusht.py                                         # demonstrations from the hub
python benchmarks/pusht.py --dataset lerobot:FOLDER --demonstrations 25
python benchmarks/sigma.py --task pusht:task --dataset lerobot:FOLDER

It needs the extra pusht (pip install -e '.[pusht]'). An episode's `coverage` is the best share of the goal
that the block covers; it is solved above 0.95.
"""

from __future__ import annotations

import sys

from options import PRESETS, script, with_parts
from robomimic import run
from torchrl.envs import EnvBase

from warmprior.data import lerobot_steps
from warmprior.envs import gym_env
from warmprior.io.extras import require
from warmprior.training import DataOptions, Task

OBSERVATION = ["observation.state", "observation.environment_state"]  # the agent, the block's corners


def make_env() -> EnvBase:
    """The environment, in raw units."""
    require("gym_pusht", "pusht")
    import gymnasium

    name, seen = "gym_pusht/PushT-v0", "environment_state_agent_pos"
    env = gymnasium.make(name, obs_type=seen, render_mode="rgb_array")
    keys = ["agent_pos", "environment_state"]
    return gym_env(env, success="is_success", measures=["coverage"], observation_keys=keys)


def task(options: DataOptions) -> Task:
    """The demonstrations, and where policies are played."""
    place = str(options.dataset or "lerobot/pusht_keypoints").removeprefix("lerobot:")
    steps = lerobot_steps(place, OBSERVATION)
    if options.demonstrations:
        steps = steps[steps["episode"] < options.demonstrations[0]]
    return Task.of("pusht", steps, make_env, success="is_success", measures={"coverage": "max"}, film_rate=10)


# All human demonstrations, unless --demonstrations says how many. On 25,650 steps of theirs the usual 10,000
# iterations stop early: at one step the Gaussian source scores 0.59 after them, and 0.78 after these.
HUMAN = {"data": {"task": ("pusht:task",), "demonstrations": ()}}
LONGER = {"training": {"iterations": 22_500}}


@script("pusht.py", together=True)
def main(argv: list[str] | None) -> None:
    presets = {
        name: with_parts(p, **HUMAN | ({} if name == "paper" else LONGER)) for name, p in PRESETS.items()
    }
    run(argv, presets, "pusht", __doc__)


if __name__ == "__main__":
    sys.exit(main())
