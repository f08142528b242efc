"""A task of a user's own whose comparisons take seconds."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from tests.benchmarks.script_parts import command_line
from warmprior import PastPrior
from warmprior.training import Task

H, OBSERVATION_DIM, ACTION_DIM = 4, 19, 7


class DriftEnv(EnvBase):
    """A state that drifts with the actions from a start by seed; the task is to go to one side.

    Episodes last 9 to 15 steps. It measures how far it is on that side.
    """

    def __init__(self) -> None:
        super().__init__(device="cpu", batch_size=[])
        self.seed_ = 0

        def flag():
            return Categorical(2, dtype=torch.bool, shape=(1,))

        self.observation_spec = Composite(
            observation=Unbounded((OBSERVATION_DIM,)), solved=flag(), side=Unbounded((1,))
        )
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite({k: flag() for k in ("done", "terminated", "truncated")})

    def _set_seed(self, seed):
        self.seed_ = seed

    def _says(self, done):
        side = self.state[:ACTION_DIM].sum()
        return {
            "observation": self.state.clone(),
            "solved": done & (side > 0),
            "side": side.reshape(1),
            "done": done,
            "terminated": done,
            "truncated": torch.zeros(1, dtype=torch.bool),
        }

    def _reset(self, tensordict=None, **kwargs):
        self.left = 9 + self.seed_ % 7
        generator = torch.Generator().manual_seed(self.seed_)
        self.state = torch.randn(OBSERVATION_DIM, generator=generator)
        return TensorDict(self._says(torch.zeros(1, dtype=torch.bool)), [])

    def _step(self, tensordict):
        self.left -= 1
        self.state = self.state.clone()
        self.state[:ACTION_DIM] += 0.4 * tensordict["action"]
        said = self._says(torch.tensor([self.left == 0]))
        return TensorDict(said | {"reward": torch.zeros(1)}, [])


def demonstrations(seed=0):
    generator = torch.Generator().manual_seed(seed)
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
    return torch.cat(episodes)


def task(options=None, seed=0):
    """Named as ``--task tests.benchmarks.drift:task``."""
    return Task.of(
        "drift",
        demonstrations(seed),
        DriftEnv,
        style="own",
        success="solved",
        measures={"side": "max"},
    )


def other(options):
    """The same with other demonstrations."""
    return task(options, seed=1)


class Widening(PastPrior, torch.nn.Module):
    """A source whose noise is learnt with the flow."""

    name = "widening"

    def __init__(self, chunk_length, *, sigma=0.5):
        torch.nn.Module.__init__(self)
        super().__init__(chunk_length, sigma=sigma)
        self.scale = torch.nn.Parameter(torch.ones(()))

    def distribution(self, history, observation=None):
        source = super().distribution(history, observation)
        return replace(source, scale=self.scale * source.scale)


def arguments(out, **more):
    """A command line of robomimic.py on it."""
    values = {
        "task": f"{__name__}:task",
        "out": out,
        "prior": ["gaussian", "past", "preview"],
        "chunk": H,
        "iterations": 20,
        "batch_size": 16,
        "learning_rate": 1e-2,
        "checkpoints": 2,
        "log_every": 5,
        "hidden_dim": 16,
        "episodes": 7,
        "seeds": 2,
        "nfe": [3, 1],
        "envs": 1,
        "logger": "none",
    }
    return command_line(**values | more)
