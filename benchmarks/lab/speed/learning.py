"""Control steps per second while an agent learns, over those of its environments alone."""

from __future__ import annotations

from functools import partial

import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv

from lab.speed.timing import PRIOR, Clock
from lab.speed.training import default_network
from warmprior import PriorAnchor, WarmPriorActor, keys, policy_transforms
from warmprior.envs import RobosuiteEnv
from warmprior.evaluation import parallel_env
from warmprior.io.workers import torch_threads
from warmprior.options.agent import IMPROVE
from warmprior.rl.agent import PriorSpaceAgent

ENVIRONMENTS, DECISIONS = 4, 5


def learning_over_environments(clock: Clock) -> float:
    """Four simulators of square in worker processes, and the compiled updates of ``IMPROVE``."""
    torch.manual_seed(0)
    threads = torch.get_num_threads()  # as PriorSpaceTraining, whose updates take those of waiting workers
    policy = WarmPriorActor(default_network(), PRIOR, nfe=1).eval()
    workers = parallel_env(partial(RobosuiteEnv, "square"), partial(policy_transforms, policy), ENVIRONMENTS)
    env = TransformedEnv(workers, PriorAnchor(policy))
    env.set_seed(0, static_seed=True)
    agent = PriorSpaceAgent(policy, IMPROVE)
    agent.compile()
    buffer = ReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=IMPROVE.batch_size)
    after = env.reset()
    chunk = agent.policy(after.copy())[keys.CHUNK]  # what simulators alone execute, again and again

    def alone() -> None:
        nonlocal after
        for _ in range(DECISIONS):
            _, after = env.step_and_maybe_reset(after.set(keys.CHUNK, chunk))

    def learning() -> None:
        nonlocal after
        for _ in range(DECISIONS):
            with torch.no_grad():
                decided, after = env.step_and_maybe_reset(agent.policy(after.exclude(keys.CHUNK)))
            buffer.extend(decided)
            with torch_threads(threads):
                agent.learn(buffer)

    ratio = clock.ratio(alone, learning)
    env.close(raise_if_closed=False)
    return ratio
