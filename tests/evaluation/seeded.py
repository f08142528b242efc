"""An environment whose episodes follow from their seeds, as in a simulator, and a policy for it."""

import time
from functools import partial

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Categorical

from tests.toy_env import CountingEnv
from warmprior import (
    PastPrior,
    WarmPriorActor,
    policy_transforms,
)
from warmprior.evaluation import Episode, parallel_env

H = 3


class SeededEnv(CountingEnv):
    """Episode length, start and success follow from the seed as in a simulator.

    Episode of seed ``s`` lasts ``3 + s % 5`` steps and is solved if ``s`` is divisible by 3. With
    ``log`` every reset appends its seed to a file.
    """

    def __init__(self, log=None, sleep=0.0):
        super().__init__()
        self.log, self.sleep = log, sleep
        self.base, self.count, self.seed_ = 0, 0, 0
        self.observation_spec["success"] = Categorical(2, dtype=torch.bool, shape=(1,))

    def _set_seed(self, seed):
        self.base, self.count = seed, 0

    def _reset(self, tensordict=None, **kwargs):
        self.seed_ = self.base + self.count
        self.count += 1
        self.length = length_of(self.seed_)
        self.episode = self.seed_ - 1  # CountingEnv shows it in its observation
        if self.log is not None:
            with open(self.log, "a") as file:
                file.write(f"{self.seed_}\n")
        return super()._reset(tensordict)

    def _seen(self, out):
        return out.set("success", out["done"] & (self.seed_ % 3 == 0))

    def _step(self, tensordict):
        time.sleep(self.sleep)
        return super()._step(tensordict)


def length_of(seed):
    return 3 + seed % 5


def expected(first_seed, episodes):
    seeds = range(first_seed, first_seed + episodes)
    nothing = TensorDict({}, [0])  # decisions take no part in comparisons
    return [Episode(seed, seed % 3 == 0, length_of(seed), nothing) for seed in seeds]


class Recorder(nn.Module):
    """A velocity that depends on the observation, and remembers which episodes it saw."""

    def __init__(self):
        super().__init__()
        self.weight, self.seen = nn.Parameter(torch.tensor(0.1)), set()

    def forward(self, t, a, observation):
        self.seen.update(observation[:, -1, 1].int().tolist())
        return self.weight * observation.mean((1, 2))[:, None, None] - a


PRIOR = PastPrior(H)


def environments(num_envs, **options):
    return parallel_env(partial(SeededEnv, **options), partial(policy_transforms, PRIOR), num_envs)


def actor_for(prior=PRIOR):
    return WarmPriorActor(Recorder(), prior, nfe=2)
