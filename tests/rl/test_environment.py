from functools import partial

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import Compose, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import raises
from tests.rl.training_parts import SolvableEnv
from tests.toy_env import ACTION_DIM, CountingEnv, closing, mlp_actor
from warmprior import (
    ActionHistory,
    ChunkStep,
    GaussianPrior,
    PastPrior,
    PreviewPrior,
    PriorAnchor,
    PriorDecoder,
    PriorSpace,
    keys,
    make_prior_space_actor,
    policy_transforms,
)
from warmprior.evaluation import play_episode

H, TO, D_O, DELTA = 3, 2, 2 + ACTION_DIM, 0.5
LENGTHS = (7, 4)
WHERE = {keys.NOISE: ("next", "decoded", "noise"), keys.CHUNK: ("next", "decoded", "chunk")}
make_actor = partial(mlp_actor, nfe=2, clip=1.0)


def make_decoder(prior):
    return PriorDecoder(make_actor(prior), delta=DELTA)


def make_agent(prior):
    sizes = ACTION_DIM, D_O, prior.prediction_length, TO
    return make_prior_space_actor(*sizes, delta=DELTA, hidden_dim=8)


def transforms_of(prior, decoder=None, **options):
    transforms = policy_transforms(prior, observation_steps=TO, **options)
    transforms.append(PriorAnchor(make_actor(prior)))
    if decoder is not None:
        transforms.append(PriorSpace(decoder))
    return transforms


def make_env(prior, decoder=None, batched=SerialEnv, truncate=False, **options):
    base = batched(2, [partial(CountingEnv, n, truncate) for n in LENGTHS])
    return TransformedEnv(base, transforms_of(prior, decoder, **options))


@pytest.mark.parametrize(("collect", "execute"), [(False, H), (True, 2)])
@pytest.mark.parametrize("prior_class", [GaussianPrior, PastPrior, PreviewPrior])
def test_both_wirings_give_bit_identical_transitions(prior_class, collect, execute):
    prior = prior_class(H)
    decoder = make_decoder(prior)
    agent, results = make_agent(prior), []
    for inside in (False, True):
        env = make_env(prior, decoder if inside else None, execute=execute)
        policy = agent if inside else TensorDictSequential(agent, decoder)
        env.set_seed(3)
        torch.manual_seed(1)
        if collect:
            collector = Collector(env, policy, frames_per_batch=16, total_frames=48)
            results.append(torch.cat(list(collector), 1))
            collector.shutdown()
        else:
            results.append(env.rollout(9, policy, break_when_any_done=False))
    outside, inside = results
    names = [key for key in outside.keys(True, True) if "collector" not in key]
    assert {"observation", *WHERE, ("next", "prior", "anchor")} <= set(names)
    for key in names:
        assert torch.equal(outside[key], inside[WHERE.get(key, key)]), key
    assert outside["next", "done"].sum() >= 3


@pytest.mark.parametrize("batched", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
def test_specs_and_random_actions(batched):
    prior = PreviewPrior(H)
    with closing(make_env(prior, make_decoder(prior), batched)) as env:
        check_env_specs(env)
        assert env.action_keys == [("prior", "delta")]
        spec = env.full_action_spec["prior", "delta"]
        assert spec.shape == (2, 2 * H, ACTION_DIM)
        assert torch.equal(spec.high, torch.full_like(spec.high, DELTA))
        assert torch.equal(spec.low, torch.full_like(spec.low, -DELTA))
        torch.manual_seed(0)
        data = env.rollout(20, break_when_any_done=False)
        delta = data["prior", "delta"]
        assert delta.abs().max() <= DELTA and delta.std() == pytest.approx(DELTA / 3**0.5, rel=0.1)
        # The decoded chunk is the one that was executed: the toy's observation holds the last action.
        chunk, k = data["next", "decoded", "chunk"], data["next", "executed_steps"]
        last = chunk.gather(-2, (k - 1).unsqueeze(-1).expand(*k.shape[:-1], 1, ACTION_DIM))
        assert torch.equal(data["next", "observation"][..., -1, 2:], last.squeeze(-2))
        noise = data["next", "decoded", "noise"]
        assert torch.equal(noise, data["prior", "anchor"] + delta)


def test_an_episode_of_an_agent_has_the_decoded_chunks():
    prior = PastPrior(H)
    env = TransformedEnv(SolvableEnv(LENGTHS[0]), transforms_of(prior, make_decoder(prior)))
    decisions = play_episode(make_agent(prior), env, seed=0).decisions
    assert decisions["vla_action", "chunk"].shape[-2:] == (H, ACTION_DIM)


def test_without_anchor_or_chunks():
    decoder = make_decoder(PastPrior(H))
    chain = Compose(ChunkStep(H), ActionHistory(H), PriorSpace(decoder))
    with raises(KeyError, "PriorAnchor"):
        TransformedEnv(CountingEnv(7), chain).rollout(1)
    with raises(KeyError, "ChunkStep"):
        TransformedEnv(CountingEnv(7), PriorSpace(decoder)).full_action_spec  # noqa: B018
