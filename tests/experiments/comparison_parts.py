"""Comparisons that take seconds, on a problem of a user's own."""

from __future__ import annotations

import json
import os
import time
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from warmprior.experiments import (
    Comparison,
    EvaluationOptions,
    Method,
    NetworkOptions,
    Problem,
    Recipe,
    RunOptions,
    Store,
)
from warmprior.io.files import load_file
from warmprior.modules import Normalizer
from warmprior.training import TrainingConfig

H = 4
METHODS = tuple(Method(name, H) for name in ("gaussian", "past", "preview"))
OBSERVATION_DIM, ACTION_DIM = 19, 7
TRAINING = TrainingConfig(
    iterations=20, batch_size=16, learning_rate=1e-2, checkpoints=2, log_every=5
)


class DriftEnv(EnvBase):
    """A state that drifts with the actions from a start by seed; the task is to go to one side.

    Episodes last 9 to 15 steps. ``log`` receives a file per episode and process.
    """

    def __init__(self, log: Path | None = None, sleep: float = 0.0) -> None:
        super().__init__(device="cpu", batch_size=[])
        self.log, self.sleep, self.seed_ = log, sleep, 0

        def flag():
            return Categorical(2, dtype=torch.bool, shape=(1,))

        self.observation_spec = Composite(observation=Unbounded((OBSERVATION_DIM,)), success=flag())
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite({k: flag() for k in ("done", "terminated", "truncated")})

    def _set_seed(self, seed):
        self.seed_ = seed

    def _reset(self, tensordict=None, **kwargs):
        self.left = 9 + self.seed_ % 7
        generator = torch.Generator().manual_seed(self.seed_)
        self.state = torch.randn(OBSERVATION_DIM, generator=generator)
        if self.log is not None:
            (self.log / f"{self.seed_}-{os.getpid()}-{time.monotonic_ns()}").touch()
        no = torch.zeros(1, dtype=torch.bool)
        state = self.state.clone()
        return TensorDict(
            {"observation": state, "success": no, **dict.fromkeys(self.done_keys, no)}, []
        )

    def _step(self, tensordict):
        time.sleep(self.sleep)
        self.left -= 1
        self.state = self.state.clone()
        self.state[:ACTION_DIM] += 0.1 * tensordict["action"]
        done = torch.tensor([self.left == 0])
        return TensorDict(
            {
                "observation": self.state,
                "success": done & (self.state[:ACTION_DIM].sum() > 0),
                "reward": torch.zeros(1),
                "done": done,
                "terminated": done,
                "truncated": torch.zeros(1, dtype=torch.bool),
            },
            [],
        )


def drift_problem(env=None):
    """A user's own: demonstrations made here, in units of their own, and an environment of ours."""
    generator = torch.Generator().manual_seed(0)
    episodes = [
        TensorDict(
            {
                "observation": torch.randn(n, OBSERVATION_DIM, generator=generator).cumsum(0),
                "action": torch.randn(n, ACTION_DIM, generator=generator).tanh(),
                "episode": torch.full((n,), i),
            },
            [n],
        )
        for i, n in enumerate((30, 5, 40))
    ]
    data = torch.cat(episodes)
    normalizer = Normalizer.fit(data)
    make_env = DriftEnv if env is None else partial(lambda env: env, env)
    return Problem(
        "drift", "own", normalizer.normalize(data), make_env, "1", normalizer=normalizer, clip=1.0
    )


def comparison(
    folder,
    envs,
    *,
    methods=METHODS,
    kind=Store,
    training=TRAINING,
    resume=False,
    episodes=5,
    seeds=2,
    problem=None,
    logger="none",
    precondition=True,
    play_on=False,
    grid="uniform",
    engine="local",
    ray_address=None,
):
    recipe = Recipe(
        network=NetworkOptions(hidden_dim=16, precondition=precondition),
        training=training,
        evaluation=EvaluationOptions(
            seeds=seeds, episodes=episodes, nfe=(3, 1), play_on=play_on, grid=grid
        ),
        run=RunOptions(
            out=folder / "out",
            resume=resume,
            envs=envs,
            logger=logger,
            engine=engine,
            ray_address=ray_address,
        ),
    )
    store = kind(
        problem or drift_problem(),
        recipe.network,
        folder / "policies",
        folder / "out" / "logs",
        recipe.run,
    )
    return Comparison(recipe, stores=[store], methods=methods)


def stored(folder):
    return json.loads((folder / "out" / "results.json").read_text())


def rows_of(folder):
    return [
        {**row["facts"], **row["measures"], "outcomes": row["outcomes"]}
        for row in stored(folder)["rows"]
    ]


def weights(folder):
    return {
        f"{path.parents[1].name}/{path.parent.name}/{name}": value
        for path in (folder / "policies").rglob("policy_*/model.safetensors")
        for name, value in load_file(path).items()
    }
