"""A policy improved by an agent decodes what the agent's environment decodes, and is a policy like others."""

import sys
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.errors import raises
from tests.processes import apart
from tests.rl.training_parts import H, SolvableEnv, make_actor
from tests.states import same
from tests.toy_env import ACTION_DIM, Halfway, Learned, random_history, stirred
from warmprior import (
    GaussianPrior,
    HistoryObservation,
    PastPrior,
    PreviewPrior,
    PriorAnchor,
    PriorDecoder,
    RealTimeChunking,
    VelocityMLP,
    keys,
    make_prior_space_actor,
    policy_transforms,
)
from warmprior.deploy import AsyncExecutor
from warmprior.evaluation import evaluate
from warmprior.history import ENTRIES
from warmprior.rl import improved_policy
from warmprior.saving import load_policy, save_policy

WIDTH = 2 + ACTION_DIM


def make_agent(actor, **options):
    torch.manual_seed(1)
    width = WIDTH + actor.sees_history * HistoryObservation.width(H, ACTION_DIM)
    read = [actor.observation_key, keys.ANCHOR]
    sizes = (ACTION_DIM, width, actor.prior.prediction_length, 1)
    agent = make_prior_space_actor(*sizes, **{"delta": 0.7, "hidden_dim": 8, "in_keys": read} | options)
    return stirred(agent)


CASES = {
    "past": (PastPrior(H), {}),
    "preview": (PreviewPrior(H), {}),
    "gaussian": (GaussianPrior(H), {}),
    "learned": (Learned(H), {}),
    "sees history": (PastPrior(H), {"see_history": True}),
    "one residual": (PastPrior(H), {}),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_chunks_are_those_that_the_environment_of_the_agent_decodes(case, dtype):
    """The anchor by the environment's transform, then agent and decoder; the policy in one call."""
    prior, options = CASES[case]
    actor = make_actor(prior, **options)
    if case == "learned":
        with torch.no_grad():
            prior.shift.add_(0.3)
    residual_length = 1 if case == "one residual" else None
    agent = make_agent(actor, residual_length=residual_length)
    history = random_history(prior, 6)
    history = history.apply(lambda v: v.to(dtype) if v.is_floating_point() else v)
    data = TensorDict({keys.OBSERVATION: torch.randn(6, 1, WIDTH, dtype=dtype), keys.HISTORY: history}, [6])
    if actor.sees_history:
        data = HistoryObservation()(data)
    noise = torch.randn(6, prior.prediction_length, ACTION_DIM, dtype=dtype)

    anchored = anchor_of(actor, data.clone(), noise)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        decoder = PriorDecoder(actor.replace(nfe=1), delta=0.7, residual_length=residual_length)
        decided = TensorDictSequential(agent, decoder)(anchored)
        policy = improved_policy(actor, agent, nfe=1)
        start = policy.start(noise, data[keys.HISTORY], data[actor.observation_key])
        data.set(policy.sampler.out_keys[-1], start)
        chunk = policy.integrate(data)[keys.CHUNK]
    assert torch.equal(start, decided[keys.NOISE])
    assert torch.equal(chunk, decided[keys.CHUNK]) and chunk.dtype == dtype


def anchor_of(actor, data, noise):
    """Write the anchor of :class:`PriorAnchor`, which would draw this noise."""
    transform, drawn = PriorAnchor(actor), torch.randn
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "randn", lambda shape, **like: noise if shape == noise.shape else drawn(shape))
        return transform._call(data)


def test_a_start_point_of_the_policy_before():
    """The flow is entered at its time, at its centre and what the agent adds."""
    actor = make_actor().replace(start=Halfway(0.2))
    agent, history = make_agent(actor), random_history(PastPrior(H), 6)
    data = TensorDict({keys.OBSERVATION: torch.randn(6, 1, WIDTH), keys.HISTORY: history}, [6])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        anchored = PriorAnchor(actor)._call(data.clone())
        decided = TensorDictSequential(agent, PriorDecoder(actor, delta=0.7))(anchored)
        policy = improved_policy(actor, agent)
        chunk = policy(data)[keys.CHUNK]
    assert policy.start.time == policy.ode.start_time == 0.5
    assert torch.equal(chunk, decided[keys.CHUNK])


def test_it_is_greedy_unless_asked_otherwise():
    actor = make_actor()
    agent, history = make_agent(actor), random_history(PastPrior(H), 4, cold=0.0)
    data = TensorDict({keys.OBSERVATION: torch.randn(4, 1, WIDTH), keys.HISTORY: history}, [4])

    def chunks(greedy):
        policy = improved_policy(actor, agent, greedy=greedy)
        with torch.no_grad():
            return [policy(data.clone())[keys.CHUNK] for _ in range(2)]

    one, two = chunks(True)  # no position is cold, so nothing is random
    assert torch.equal(one, two)
    one, two = chunks(False)
    assert not torch.equal(one, two)


@pytest.mark.parametrize("case", CASES)
def test_it_is_saved_and_plays_like_any_policy(case, tmp_path):
    prior, options = CASES[case]
    actor = make_actor(prior, **options)
    policy = improved_policy(actor, make_agent(actor), nfe=2)
    save_policy(policy, tmp_path)
    again = load_policy(tmp_path)
    assert same(again.state_dict(), policy.state_dict()) and again.sampling == policy.sampling
    envs = [TransformedEnv(SolvableEnv(7), policy_transforms(again)) for _ in range(2)]
    rollouts = [evaluate(p, e, episodes=3, first_seed=5) for p, e in zip((policy, again), envs, strict=True)]
    assert rollouts[0] == rollouts[1] and len(rollouts[0]) == 3
    env = envs[0]
    assert env.rollout(4, again)[keys.CHUNK].shape[-2:] == (prior.prediction_length, ACTION_DIM)
    with AsyncExecutor(again, latency=1) as executor:
        assert executor.act(torch.zeros(WIDTH)).shape == (ACTION_DIM,)


def test_a_process_that_knows_no_agents_loads_it(tmp_path):
    actor = make_actor().replace(network=VelocityMLP(ACTION_DIM, WIDTH, H, observation_steps=1))
    save_policy(improved_policy(actor, make_agent(actor), nfe=2), tmp_path)

    @apart
    def loaded():
        """As a new process, which would import PyTorch for seconds, but no part of this library."""
        for name in [name for name in sys.modules if name.split(".")[0] == "warmprior"]:
            del sys.modules[name]
        from warmprior.saving import load_policy

        agents = "warmprior.rl" in sys.modules
        return agents, load_policy(tmp_path).start.name

    assert loaded() == (False, "agent")


def test_the_policy_before_stays_as_it_is():
    actor = make_actor(Learned(H))
    agent = make_agent(actor)
    before = {name: value.clone() for name, value in (actor.state_dict() | agent.state_dict()).items()}
    policy = improved_policy(actor, agent)
    with torch.no_grad():
        for value in policy.start.parameters():
            value.add_(1.0)
    assert same(before, actor.state_dict() | agent.state_dict())
    assert actor.start is None and not any(v.requires_grad for v in policy.start.parameters())
    assert policy.network is actor.network


class Seeing(VelocityMLP):
    encodes = True


@pytest.mark.parametrize(
    ("change", "agent", "words"),
    [
        ({"guidance": RealTimeChunking(execution_horizon=2)}, {}, ["guidance=None"]),
        ({}, {"in_keys": [keys.OBSERVATION, "goal"]}, ["goal", "anchor"]),
        ({"network": Seeing(ACTION_DIM, WIDTH, H, observation_steps=1)}, {}, ["images"]),
    ],
)
def test_what_no_policy_can_do_is_refused(change, agent, words):
    actor = make_actor()
    with raises(ValueError, *words):
        improved_policy(actor.replace(**change), make_agent(actor, **agent))


def test_agents_of_ones_own_are_refused():
    with raises(TypeError, "make_prior_space_actor", "SimpleNamespace"):
        improved_policy(make_actor(), SimpleNamespace())


def test_an_agent_that_reads_the_last_actions():
    actor = make_actor()
    agent = make_agent(actor, in_keys=[keys.OBSERVATION, keys.ANCHOR, keys.ACTIONS])
    history = random_history(PastPrior(H), 4)
    assert set(history.keys()) == set(ENTRIES)
    data = TensorDict({keys.OBSERVATION: torch.randn(4, 1, WIDTH), keys.HISTORY: history}, [4])
    with torch.no_grad():
        chunk = improved_policy(actor, agent)(data)[keys.CHUNK]
    assert chunk.isfinite().all()
