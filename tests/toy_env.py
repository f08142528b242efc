"""A deterministic environment whose returns, lengths and observations are known in closed form; histories."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from warmprior.history import advance, cold_history, without

ACTION_DIM = 2


class CountingEnv(EnvBase):
    """Observation ``[step, episode, *last action]``; reward ``step`` at each step; ends after ``length``."""

    def __init__(self, length: int = 7, truncate: bool = False, device: str | None = "cpu") -> None:
        super().__init__(device=device, batch_size=[])
        self.length, self.truncate = length, truncate
        self.observation_spec = Composite(observation=Unbounded((2 + ACTION_DIM,)))
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(
            {key: Categorical(2, dtype=torch.bool, shape=(1,)) for key in ("done", "terminated", "truncated")}
        )
        self.t, self.episode = 0, -1

    def _observation(self, action: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.tensor([float(self.t), float(self.episode)]), action])

    def _reset(self, tensordict=None, **kwargs):
        self.t = 0
        self.episode += 1
        out = TensorDict({"observation": self._observation(torch.zeros(ACTION_DIM))}, [])
        return out.update(self.full_done_spec.zero())

    def _step(self, tensordict):
        self.t += 1
        done = torch.tensor([self.t >= self.length])
        never = torch.zeros(1, dtype=torch.bool)
        return TensorDict(
            {
                "observation": self._observation(tensordict["action"]),
                "reward": torch.tensor([float(self.t)]),
                "done": done,
                "terminated": never if self.truncate else done,
                "truncated": done if self.truncate else never,
            },
            [],
        )

    def _set_seed(self, seed):
        return seed


class ChunkPolicy(TensorDictModuleBase):
    """A policy from a function ``tensordict -> chunk [*B, P, d_a]``."""

    def __init__(self, chunk) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], [("vla_action", "chunk")]
        self.chunk = chunk

    def forward(self, tensordict):
        return tensordict.set(self.out_keys[0], self.chunk(tensordict))


def random_history(prior, *batch, action_dim: int = ACTION_DIM, seed: int = 0, cold: float = 0.5):
    """Histories after ``H`` executed actions, of which about a share is cold."""
    generator = torch.Generator().manual_seed(seed)
    shape = prior.history_length, prior.prediction_length, action_dim
    chunk = torch.randn(*batch, *shape[1:], generator=generator)
    executed = torch.full((*batch, 1), prior.chunk_length)
    history = advance(cold_history(batch, *shape), chunk, executed)
    return without(history, torch.rand(batch, generator=generator) < cold)
