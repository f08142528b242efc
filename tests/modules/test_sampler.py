import pytest
import torch
from tensordict import TensorDict

from tests.toy_env import random_history
from warmprior import PastPrior, PriorSampler, Source, StartPoint, VelocityMLP, WarmPriorActor, keys
from warmprior.history import ENTRIES


class Observing(PastPrior):
    name = "observing-of-the-sampler"

    def distribution(self, history, observation=None):
        source = super().distribution(history)
        loc, scale, warm = source.loc, source.scale, source.warm
        return Source(loc + observation[..., -1:, :], scale, warm)


class There(StartPoint):
    name = "there-of-the-sampler"
    time = noise_share = 0.5

    def forward(self, noise, history, observation):
        return observation[..., -1:, :].expand_as(noise)


@pytest.mark.parametrize("part", ["prior", "start"])
def test_the_observation_is_an_input_where_it_is_read(part):
    prior = PastPrior(4) if part == "start" else Observing(4, sigma=0.0)
    start = There() if part == "start" else None
    history = random_history(prior, 3, cold=0.0)
    data = TensorDict({"history": history, "state": torch.randn(3, 1, 2)}, [3])
    sampler = PriorSampler(prior, start=start, observation_key="state")
    assert sampler.in_keys == [*((keys.HISTORY, name) for name in ENTRIES), "state"]
    noise = sampler(data.select(*sampler.in_keys))["prior", "noise"]
    mean = 0 if part == "start" else history["actions"]
    assert torch.equal(noise, mean + data["state"].expand_as(noise))
    unread = PriorSampler(PastPrior(4), observation_key="state")
    assert "state" not in unread.in_keys
    actor = WarmPriorActor(VelocityMLP(2, 2, 4, 1), prior, start=start, observation_key="state")
    assert actor.in_keys == ["state", *((keys.HISTORY, name) for name in ENTRIES)]


def test_the_usual_observation_is_read_and_outputs_can_be_selected():
    history = random_history(PastPrior(4), 3, cold=0.0)
    data = TensorDict({"history": history, "observation": torch.randn(3, 1, 2)}, [3])
    sampler = PriorSampler(Observing(4, sigma=0.0))
    noise = sampler(data.clone())["prior", "noise"]
    assert torch.equal(noise, history["actions"] + data["observation"])
    out = sampler.select_out_keys(keys.NOISE)(data.clone())
    assert torch.equal(out["prior", "noise"], noise) and "loc" not in out["prior"]
