"""Evaluation: every episode once, whatever the environment."""

from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import Categorical
from torchrl.envs import (
    Compose,
    ConditionalSkip,
    FrameSkipTransform,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from tests.errors import raises, refuses
from tests.evaluation.seeded import (
    PRIOR,
    H,
    Recorder,
    SeededEnv,
    actor_for,
    environments,
    expected,
    length_of,
)
from tests.toy_env import ACTION_DIM, CountingEnv, closing, mlp_actor
from warmprior import (
    GaussianPrior,
    Normalizer,
    PastPrior,
    PriorAnchor,
    PriorDecoder,
    ResidualSampler,
    WarmPriorActor,
    normalizing_transforms,
    policy_transforms,
)
from warmprior.data import demonstrations_of
from warmprior.evaluation import evaluate, parallel_env, play_episode
from warmprior.tasks import Play, Task


class NoiseSuccess(SeededEnv):
    """Success depends on what the policy does, and so on its random numbers."""

    def _step(self, tensordict):
        out = super()._step(tensordict)
        return out.set("success", tensordict["action"].sum(-1, keepdim=True) > 0)


class PlainEnv(SeededEnv):
    """As most of TorchRL's environments: resets are numbered from the seed, and workers unknown."""

    def __init__(self, log=None):
        super().__init__(log=log)


def single(make_env=PlainEnv, prior=PRIOR):
    return TransformedEnv(make_env(), policy_transforms(prior))


def chunks_of(episodes):
    return torch.cat([episode.decisions["vla_action", "chunk"] for episode in episodes])


def test_an_episode_depends_on_its_seeds_alone():
    """Not on the environment's history, the policy's generators, or the order of the episodes."""
    env, actor = single(NoiseSuccess), actor_for()
    torch.manual_seed(0)
    whole = evaluate(actor, env, episodes=9, first_seed=3, policy_seed=2)
    torch.rand(5)
    again = [
        play_episode(actor, env if seed % 2 else single(NoiseSuccess), seed, policy_seed=2)
        for seed in range(11, 2, -1)
    ]
    assert again[::-1] == whole
    assert torch.equal(chunks_of(again[::-1]), chunks_of(whole))


def test_the_noise_of_an_episode_is_that_of_the_documented_seed():
    actor = actor_for(GaussianPrior(H))
    actor.forward = lambda data, generator: data.set(
        ("vla_action", "chunk"), actor.sampler(data, generator)["prior", "noise"]
    )
    first = {}
    for seeds in ((0, 7), (7, 0), (1, 7), (0, 8), (2**32, 7)):
        noise_seed = int(np.random.SeedSequence(seeds).generate_state(1, "uint64")[0])
        generator = torch.Generator().manual_seed(noise_seed)
        policy_seed, seed = seeds
        env = single(prior=GaussianPrior(H))
        episode = play_episode(actor, env, seed, policy_seed=policy_seed)
        for chunk in episode.decisions["vla_action", "chunk"]:
            assert torch.equal(chunk, torch.randn(H, ACTION_DIM, generator=generator))
        first[seeds] = tuple(episode.decisions["vla_action", "chunk"][0].flatten().tolist())
    assert len(set(first.values())) == len(first)


class Blurred(CountingEnv):
    """Draws what it shows from PyTorch's global generator."""

    def __init__(self):
        super().__init__(5)
        self.observation_spec["success"] = Categorical(2, dtype=torch.bool, shape=(1,))

    def _seen(self, out):
        seen = out["observation"] + torch.randn(2 + ACTION_DIM)
        return out.update({"observation": seen, "success": out["done"]})


def test_a_compiled_policy_plays_the_same_episodes():
    policy, chunks = mlp_actor(PRIOR, nfe=2), []
    for each in (policy, torch.compile(policy, backend="eager")):
        env = TransformedEnv(SerialEnv(2, Blurred), policy_transforms(PRIOR))
        chunks.append(chunks_of(evaluate(each, env, episodes=3, first_seed=0)))
    torch.testing.assert_close(*chunks)


def test_actor_is_left_as_it_was_but_for_its_mode():
    generator = torch.Generator().manual_seed(5)
    actor = WarmPriorActor(Recorder(), PastPrior(H), nfe=2, generator=generator).train()
    state, before = generator.get_state(), torch.get_rng_state()
    with closing(environments(1)) as env:
        evaluate(actor, env, episodes=1, first_seed=0)
    assert actor.sampler.generator is generator
    assert torch.equal(generator.get_state(), state)
    assert torch.equal(torch.get_rng_state(), before)
    assert not actor.training and actor.sampling.nfe == 2


def test_any_policy_that_writes_chunks():
    """An agent, or residuals alone: seeded, and without a trace in PyTorch's global generator."""
    prior = PastPrior(H)
    actor = actor_for(prior)
    decoder = PriorDecoder(actor, delta=0.5)
    policy = TensorDictSequential(ResidualSampler(decoder), decoder)
    transforms = partial(policy_transforms, prior)
    env = TransformedEnv(parallel_env(NoiseSuccess, transforms, 2), PriorAnchor(actor))
    play = partial(evaluate, policy, env, episodes=6, first_seed=3)
    with closing(env):
        torch.manual_seed(0)
        before = torch.get_rng_state()
        one = play()
        evaluate(actor, env, episodes=2, first_seed=3)  # the environment draws alone
        assert torch.equal(torch.get_rng_state(), before)
        torch.rand(5)
        again, other = play(), play(policy_seed=1)
    assert again == one and torch.equal(chunks_of(again), chunks_of(one))
    assert not torch.isclose(chunks_of(other)[:3], chunks_of(one)[:3]).any()


def batched(kind, make_env, num_envs, transforms_inside=False):
    options = {"mp_start_method": "fork"} if kind is ParallelEnv else {}
    if transforms_inside:
        return kind(num_envs, partial(single, make_env), **options)
    return TransformedEnv(kind(num_envs, make_env, **options), policy_transforms(PRIOR))


PLACES = {
    "one worker": lambda log: environments(1, log=log),
    "workers": lambda log: environments(3, log=log),
    "single": lambda log: single(partial(PlainEnv, log=log)),
    "transforms outside": lambda log: batched(SerialEnv, partial(PlainEnv, log=log), 3),
    "transforms inside": lambda log: batched(ParallelEnv, partial(PlainEnv, log=log), 3, True),
}


@pytest.mark.parametrize("place", PLACES)
def test_every_episode_once(place, tmp_path):
    log, actor = tmp_path / "resets", actor_for()
    with closing(PLACES[place](log)) as env:
        for first, episodes in ((40, 7), (5, 2), (60, 3), (80, 1)):
            before = len(log.read_text().split()) if log.exists() else 0
            result = evaluate(actor, env, episodes=episodes, first_seed=first)
            assert result == expected(first, episodes)
            seeds = range(first, first + episodes)
            played = [int(line) for line in log.read_text().split()][before:]
            assert set(seeds) <= actor.network.seen and set(seeds) <= set(played)
            assert place != "single" or played == list(seeds)


def test_environments_that_cannot_be_judged():
    refuses(lambda: evaluate(actor_for(), single(CountingEnv), episodes=1, first_seed=0), KeyError, "success")
    with raises(KeyError, "policy_transforms"):
        evaluate(actor_for(), PlainEnv(), episodes=1, first_seed=0)


def test_policy_and_environment_need_one_normaliser():
    ones = {"observation": torch.ones(2 + ACTION_DIM), "action": torch.ones(ACTION_DIM)}
    mine, other = (Normalizer({k: -s * v for k, v in ones.items()}, ones) for s in (1.0, 3.0))
    actor = mlp_actor(PRIOR, nfe=1, normalizer=mine)

    def play(normalizer):
        transforms = policy_transforms(PastPrior(H), normalizer=normalizer)
        env = TransformedEnv(SeededEnv(), transforms)
        return evaluate(actor, env, episodes=1, first_seed=0)

    assert play(mine)[0].steps == length_of(0)
    # Wherever the transforms are.
    transforms = [StepCounter(), policy_transforms(PastPrior(H), normalizer=mine)]
    for env in (
        TransformedEnv(SeededEnv(), Compose(*transforms)),
        TransformedEnv(TransformedEnv(SeededEnv(), transforms[1].clone()), StepCounter()),
        # The environment's own units, below, are its own.
        TransformedEnv(
            TransformedEnv(SeededEnv(), Compose(*normalizing_transforms(other))),
            transforms[1].clone(),
            auto_unwrap=False,
        ),
    ):
        assert evaluate(actor, env, episodes=1, first_seed=0)[0].steps == length_of(0)
    # Of observations alone.
    alone = Normalizer(*({"observation": s * ones["observation"]} for s in (-1.0, 3.0)))
    seen = TransformedEnv(
        SeededEnv(), Compose(*normalizing_transforms(alone), policy_transforms(PastPrior(H)))
    )
    assert evaluate(actor.replace(normalizer=alone), seen, episodes=1, first_seed=0)[0].steps == length_of(0)
    for wrong in (None, other):
        with raises(ValueError, "normalizer=policy.normalizer"):
            play(wrong)
    # An environment follows the policy.
    env = TransformedEnv(SeededEnv(), policy_transforms(actor))
    mine.load_state_dict(other.state_dict(), assign=True)
    assert evaluate(actor, env, episodes=1, first_seed=0)[0].steps == length_of(0)
    # A network's own normaliser is no policy's.
    plain = actor.replace(normalizer=None)
    plain.network.normalizer = mine
    env = TransformedEnv(SeededEnv(), policy_transforms(PRIOR))
    assert evaluate(plain, env, episodes=1, first_seed=0)[0].steps == length_of(0)


def test_workers_keep_the_statistics_that_they_started_with():
    ones = {"observation": torch.ones(2 + ACTION_DIM), "action": torch.ones(ACTION_DIM)}
    mine, other = (Normalizer({k: -s * v for k, v in ones.items()}, ones) for s in (1.0, 3.0))
    actor = mlp_actor(PRIOR, nfe=1, normalizer=mine)
    for normalizer in (mine, other):
        env = parallel_env(SeededEnv, partial(policy_transforms, PRIOR, normalizer=normalizer), 1)
        with closing(env):
            if normalizer is mine:
                assert len(evaluate(actor, env, episodes=2, first_seed=0)) == 2
                mine.load_state_dict(other.state_dict())
                with raises(ValueError, "normalizer=policy.normalizer", "close"):
                    evaluate(actor, env, episodes=2, first_seed=0)
                env.close()
            assert len(evaluate(actor, env, episodes=2, first_seed=0)) == 2
    outside = TransformedEnv(SerialEnv(1, SeededEnv), policy_transforms(PRIOR, normalizer=other))
    mine.action_scale.mul_(2)
    with raises(ValueError, "normalizer=policy.normalizer"):
        evaluate(actor, outside, episodes=2, first_seed=0)


@pytest.mark.parametrize("batch", [None, SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
@pytest.mark.parametrize(
    "outside", [FrameSkipTransform(2), ConditionalSkip(lambda data: data["executed_steps"] > 0)]
)
def test_what_repeats_or_skips_chunks_from_outside_is_refused(batch, outside):
    """Played, an episode of n steps would be one of n / 2, or never end."""

    def make():
        return TransformedEnv(SeededEnv(), policy_transforms(PRIOR))

    inside = make() if batch is None else batch(2, make)
    env = TransformedEnv(inside, Compose(StepCounter(), outside.clone()), auto_unwrap=False)
    with closing(env), raises(RuntimeError, type(outside).__name__, "inside"):
        evaluate(mlp_actor(PRIOR, nfe=1), env, episodes=2, first_seed=0)


def test_a_frame_skip_of_one_repeats_nothing_and_is_played():
    actor = mlp_actor(PRIOR, nfe=1)
    inside = SerialEnv(1, lambda: TransformedEnv(SeededEnv(), policy_transforms(PRIOR)))
    skipped = evaluate(actor, TransformedEnv(inside, FrameSkipTransform(1)), episodes=2, first_seed=0)
    assert skipped == evaluate(actor, inside, episodes=2, first_seed=0)


@pytest.mark.parametrize("given", [{"success": "solved"}, {"measures": {"reward": "sum"}}])
def test_a_task_has_its_own_success_and_measures(given):
    rows = TensorDict({"observation": torch.rand(9, 1), "action": torch.rand(9, ACTION_DIM)}, [9])
    task = Task(
        demonstrations_of(rows.set("episode", torch.zeros(9, dtype=torch.int64)), "own"),
        play=Play(CountingEnv),
    )
    with raises(ValueError, next(iter(given))):
        evaluate(mlp_actor(PastPrior(4)), task, episodes=1, first_seed=0, **given)
