"""ChunkStep and ActionHistory against ground truth, in every place where TorchRL allows them."""

from __future__ import annotations

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, StepCounter
from torchrl.envs.utils import check_env_specs

from tests.toy_env import ACTION_DIM, PLACES, placed
from warmprior import (
    ActionHistory,
    ChunkStep,
    GaussianPrior,
    PastPrior,
    PreviewPrior,
    VelocityMLP,
    WarmPriorActor,
)

H = 3
GAMMA = 0.9
LENGTHS = (7, 4)  # neither is a multiple of H: both end inside a chunk, at different times


def transforms(prior, execute):
    chunk = ChunkStep(
        prior.chunk_length, execute=execute, prediction_length=prior.prediction_length, gamma=GAMMA
    )
    return Compose(StepCounter(), chunk, ActionHistory(H), InitTracker())


def expected_mean(prior, executed, chunks):
    """The table of the design, written as plain Python over the whole episode so far."""
    if isinstance(prior, GaussianPrior) or not chunks:
        return None
    if isinstance(prior, PastPrior):
        return torch.stack(executed[-H:]) if len(executed) >= H else None
    last, k = chunks[-1]
    return last[k : k + H]


def check(data, prior, execute):
    if data.ndim == 1:
        data = data[None]
    resets = 0
    for row, length in zip(data, LENGTHS, strict=False):
        executed, chunks = [], []
        for t in range(row.shape[0]):
            step = row[t]
            time = int(step["observation"][0])
            if time == 0:
                executed, chunks = [], []
                resets += 1
            if time != len(executed):  # the batch starts inside an episode: its history is unknown
                continue
            mean = expected_mean(prior, executed, chunks)
            warm, loc = step["prior", "warm"], step["prior", "loc"]
            if mean is None:
                assert not warm.any()
            else:
                assert warm[:H].all() and not warm[H:].any()
                torch.testing.assert_close(loc[:H], mean)
            k = min(execute, length - time)
            chunk, after = step["vla_action", "chunk"], step["next"]
            assert chunk.shape == (prior.prediction_length, ACTION_DIM)
            rewards = [GAMMA**i * (time + i + 1) for i in range(k)]
            torch.testing.assert_close(after["reward"].item(), sum(rewards), rtol=1e-5, atol=0)
            assert after["executed_steps"].item() == k
            assert after["step_count"].item() == time + k
            assert after["done"].item() == (time + k == length)
            torch.testing.assert_close(after["observation"][2:], chunk[k - 1])
            executed += list(chunk[:k])
            chunks.append((chunk, k))
    return resets


@pytest.mark.parametrize(
    ("place", "prior_class", "execute"),
    [
        *((place, PreviewPrior, 2) for place in PLACES),
        *(
            (place, prior, H)
            for place in ("single", "serial-outside")
            for prior in (GaussianPrior, PastPrior)
        ),
        ("parallel-outside", PastPrior, H),
    ],
)
def test_rollout_and_collector_match_ground_truth(place, prior_class, execute):
    torch.manual_seed(0)
    prior = prior_class(H)
    network = VelocityMLP(ACTION_DIM, 2 + ACTION_DIM, prior.prediction_length, 1, hidden_dim=8)

    actor = WarmPriorActor(_Squeezed(network), prior, nfe=2, clip=1.0)
    env = placed(place, lambda: transforms(prior, execute), LENGTHS)
    try:
        check_env_specs(env)
        assert check(env.rollout(9, actor, break_when_any_done=False), prior, execute) >= 2
        collector = Collector(env, actor, frames_per_batch=18, total_frames=54)
        assert sum(check(batch, prior, execute) for batch in collector) >= 3
    finally:
        env.close(raise_if_closed=False)


class _Squeezed(torch.nn.Module):
    """Feeds the toy's single observation to a network that expects ``[B, To, d_o]``."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, t, a, observation):
        return self.network(t, a, observation[:, None])
