"""Rivals that are composed of the library's parts, against their papers' algorithms by hand."""

import pytest
import torch
from tensordict import TensorDict

from lab.methods.methods import Method
from tests.errors import refuses
from tests.toy_env import stirred
from warmprior import FlowMatchingLoss, VelocityMLP, WarmPriorActor, keys
from warmprior.history import advance, cold_history
from warmprior.training import NetworkOptions, TrainingConfig, train_policy

H = 4


def network(prediction_length):
    torch.manual_seed(0)
    return stirred(VelocityMLP(2, 3, prediction_length, observation_steps=1, hidden_dim=16), by=0.3)


def predicted(field, t, point, observation):
    """The action that a velocity field says: f = a_t + (1 - t) v."""
    return point + (1 - t) * field(torch.full((len(point),), t), point, observation)


@pytest.mark.parametrize("name", ["mip", "mip-past"])
def test_mip_is_two_supervised_steps(name):
    """f(0, t = 0) and f(0.9 a + 0.1 eps, t = 0.9), regressed on the action; 0 and eps may be a source."""
    method = Method(name, H)
    field, prior = network(H), method.prior()
    actor = WarmPriorActor(field, prior, max_nfe=2)
    loss = FlowMatchingLoss(actor, coupling=method.coupling(), reduction="none")
    loss.generator = torch.Generator().manual_seed(5)
    history = advance(cold_history([64], H, H, 2), torch.randn(64, H, 2), torch.full((64, 1), H))
    action, observation = torch.randn(64, H, 2), torch.randn(64, 1, 3)
    windows = {keys.CHUNK: action, keys.HISTORY: history, keys.OBSERVATION: observation}
    found = loss(TensorDict(windows, [64]))["loss_flow_matching"]

    same = torch.Generator().manual_seed(5)
    noise = prior.distribution(history, observation).sample(same)
    second = torch.rand(64, generator=same) < 0.5
    assert 0 < second.sum() < 64
    begun = noise if name == "mip-past" else torch.zeros_like(action)
    first = predicted(field, 0.0, begun, observation) - action
    again = predicted(field, 0.9, 0.9 * action + 0.1 * noise, observation) - action
    # Of a velocity, an error is that of the action over 1 - t.
    expected = torch.where(second[:, None, None], again / 0.1, first).square()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["mip", "mip-past"])
def test_mip_is_played_as_its_paper_says(name):
    """Two steps without noise, from the mean of the source, which is 0 for MIP."""
    method = Method(name, H)
    field = network(H)
    assert method.nfes((9, 1)) == [2] and method.temperatures((1.0, 0.5)) == [0.0]
    actor = WarmPriorActor(field, method.prior(), **method.parts.played)
    observation = torch.randn(5, 1, 3)
    last = torch.randn(5, H, 2)
    history = advance(cold_history([5], H, H, 2), last, torch.full((5, 1), H))
    data = TensorDict({keys.OBSERVATION: observation, keys.HISTORY: history}, [5])
    mean = last if name == "mip-past" else torch.zeros(5, H, 2)
    begun = predicted(field, 0.0, mean, observation)
    expected = predicted(field, 0.9, 0.9 * begun + 0.1 * mean, observation)
    torch.testing.assert_close(actor(data)[keys.CHUNK], expected, rtol=1e-4, atol=1e-5)


def test_a_warm_start_enters_the_flow_at_the_forecast():
    """(1 - s) eps + s f, where f is known and held after that."""
    method = Method("warm-start,start_time=0.25", H)
    start, prior = method.start(), method.prior()
    assert prior.prediction_length == 2 * H
    plan = torch.randn(3, 2 * H, 2)
    history = advance(cold_history([3], H, 2 * H, 2), plan, torch.full((3, 1), H))
    noise = torch.randn(3, 2 * H, 2)
    known = torch.cat([plan[:, H:], plan[:, -1:].expand(3, H, 2)], 1)
    torch.testing.assert_close(start(noise, history, None), 0.75 * noise + 0.25 * known)
    cold = start(noise, cold_history([3], H, 2 * H, 2), None)
    torch.testing.assert_close(cold, 0.75 * noise)
    refuses(lambda: Method("warm-start,start_time=1", H), ValueError, "start_time")


def test_mip_learns():
    """Two steps find an action that the observation says."""
    torch.manual_seed(0)
    method = Method("mip", H)
    observation = torch.rand(400, 1) * 2 - 1
    steps = {"observation": observation, "action": observation.sin(), "episode": torch.arange(400) // 100}
    network = NetworkOptions("mlp,hidden_dim=32", observation_steps=1)
    options = {"network": network, "training": TrainingConfig(iterations=800), "description": None}
    options |= {"coupling": method.coupling(), **method.parts.played}
    actor = train_policy(TensorDict(steps, [400]), method.prior(), **options)
    sampling = actor.sampling
    assert (sampling.evaluations(), sampling.grid, sampling.temperature) == (2, "dense-jump:0.9", 0)
    seen = torch.tensor([[-0.8], [0.0], [0.8]])
    units = actor.normalizer
    normalised = units.normalize(TensorDict({"observation": seen}, [3]))["observation"].unsqueeze(1)
    chunk = actor(TensorDict({keys.OBSERVATION: normalised, keys.HISTORY: cold_history([3], H, H, 1)}, [3]))
    first = units.denormalize(TensorDict({"action": chunk[keys.CHUNK][:, 0]}, [3]))["action"]
    torch.testing.assert_close(first, seen.sin(), atol=0.1, rtol=0)  # later ones are of other observations
