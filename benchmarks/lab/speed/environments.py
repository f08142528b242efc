"""Control steps of the library over those of the simulator alone."""

from __future__ import annotations

import statistics
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv

from lab.speed.timing import D_A, D_O, PRIOR, Clock, H
from warmprior import ChunkStep, Normalizer, policy_transforms
from warmprior.envs import RobosuiteEnv


def env_over_robosuite(clock: Clock) -> float:
    envs = RobosuiteEnv("square"), RobosuiteEnv("square", control_loop="robosuite")
    lean, robosuite = (env.loop for env in envs)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (20, D_A))

    def before() -> None:  # both play the same episode, because contacts decide what a step costs
        lean.reset(0)
        robosuite.reset(0)

    return clock.ratio(
        lambda: [robosuite.env.step(action) for action in actions],
        lambda: [lean.step(action) for action in actions],
        before=before,
    )


class Particles(EnvBase):
    """A batched simulator of ``n`` chains of masses, with ten integration steps per control step."""

    def __init__(self, n: int, masses: int = 32) -> None:
        super().__init__(batch_size=[n])
        self.observation_spec = Composite(observation=Unbounded((n, D_O)), shape=[n])
        self.action_spec = Bounded(-1, 1, (n, D_A))
        self.reward_spec = Unbounded((n, 1))
        flags = {name: Categorical(2, dtype=torch.bool, shape=(n, 1)) for name in ("done", "terminated")}
        self.done_spec = Composite(flags, shape=[n])
        self.state = torch.zeros(2, n, masses)

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)

    def _observation(self) -> torch.Tensor:
        return self.state[0, :, :D_O].clone()

    def _reset(self, tensordict: TensorDict | None = None, **kwargs: Any) -> TensorDict:
        self.state.zero_()
        return TensorDict({"observation": self._observation()}, self.batch_size).update(self.done_spec.zero())

    def _step(self, tensordict: TensorDict) -> TensorDict:
        position, velocity = self.state
        for _ in range(10):
            force = position.roll(1, -1) - 2 * position + position.roll(-1, -1) - position.pow(3)
            force[:, :D_A] += tensordict["action"]
            velocity += 0.01 * force
            position += 0.01 * velocity
        reward = position.square().sum(-1, keepdim=True)
        result = {"observation": self._observation(), "reward": reward}
        return TensorDict(result, self.batch_size).update(self.done_spec.zero())


def batched_chunk_step(clock: Clock) -> float:
    chunks = torch.rand(1024, 3, H, D_A, generator=torch.Generator().manual_seed(0)) * 2 - 1
    alone, env = Particles(1024), TransformedEnv(Particles(1024), policy_transforms(PRIOR))

    def decisions() -> None:
        data = env.reset()
        for i in range(3):
            data = env.step_mdp(env.step(data.set(("vla_action", "chunk"), chunks[:, i])))

    def control_steps() -> None:
        data = alone.reset()
        for action in chunks.flatten(1, 2).unbind(1):
            data = alone.step_mdp(alone.step(data.set("action", action)))

    return clock.ratio(decisions, control_steps)


def chunk_step_overhead(clock: Clock) -> dict[str, float]:
    # These statistics leave actions as they are, so that all sides simulate the same.
    high = {"observation": torch.ones(D_O), "action": torch.ones(D_A)}
    normalizer = Normalizer({key: -value for key, value in high.items()}, high)
    transforms: dict[str, Transform] = {
        "chunks": ChunkStep(H),
        "and history, last observations": policy_transforms(PRIOR),
        "and normaliser": policy_transforms(PRIOR, normalizer=normalizer),
    }
    alone = RobosuiteEnv("square")  # 40 of 400 steps are taken
    envs = [TransformedEnv(RobosuiteEnv("square"), transform) for transform in transforms.values()]
    chunks = torch.rand(5, H, D_A, generator=torch.Generator().manual_seed(0)) * 0.6 - 0.3
    starts: list[TensorDictBase] = []

    def before() -> None:
        for env in envs:
            env.set_seed(0, static_seed=True)
        starts[:] = [env.reset() for env in envs]
        alone.loop.reset(0)

    def decisions(i: int) -> None:
        data = starts[i]
        for chunk in chunks:
            data = envs[i].step_mdp(envs[i].step(data.set(("vla_action", "chunk"), chunk)))

    def control_steps() -> None:
        for action in chunks.flatten(0, 1).numpy():
            alone.loop.step(action)

    times = clock.times(control_steps, *(partial(decisions, i) for i in range(len(envs))), before=before)
    base, *others = times
    overheads = (statistics.median(a / b for a, b in zip(one, base, strict=True)) - 1 for one in others)
    return dict(zip(transforms, overheads, strict=True))
