"""PriorAnchor: the mean where it is warm, observed noise where it is cold, one seed one result."""

from __future__ import annotations

import copy
import itertools
import pickle
from functools import partial

import pytest
import torch
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.toy_env import ACTION_DIM, CountingEnv
from warmprior import (
    ActionHistory,
    ChunkStep,
    GaussianPrior,
    ObservationStack,
    PastPrior,
    PreviewPrior,
    PriorAnchor,
    StartPoint,
    VelocityMLP,
    WarmPriorActor,
)
from warmprior.modules.prior import Source

H = 3
LENGTHS = (7, 4)
PLACES = ("single", "serial-outside", "serial-inside", "parallel-outside", "parallel-inside")
PRIORS = [GaussianPrior, PastPrior, PreviewPrior]
WIDTH = 2 + ACTION_DIM


def actor_for(prior, **options):
    network = VelocityMLP(ACTION_DIM, WIDTH, prior.prediction_length, 1, hidden_dim=8)
    return WarmPriorActor(network, prior, **options)


def history(prior, execute=None):
    chunk = ChunkStep(prior.chunk_length, execute=execute, prediction_length=prior.prediction_length)
    return [chunk, ActionHistory(prior.history_length)]


def anchored(env, prior, execute=None, **options):
    return TransformedEnv(env, Compose(*history(prior, execute), PriorAnchor(actor_for(prior), **options)))


def single(prior, length, **options):
    return anchored(CountingEnv(length), prior, **options)


def build(place, prior, **options):
    if place == "single":
        return single(prior, LENGTHS[0], **options)
    batched = SerialEnv if "serial" in place else partial(ParallelEnv, mp_start_method="fork")
    if place.endswith("outside"):
        return anchored(batched(2, [partial(CountingEnv, n) for n in LENGTHS]), prior, **options)
    workers = [partial(single, prior, n, **options) for n in LENGTHS]
    return batched(2, workers)


@pytest.mark.parametrize(
    ("place", "prior_class", "execute"),
    [
        *itertools.product(PLACES[:3], PRIORS, [H, 2]),
        *itertools.product(PLACES[3:], [PastPrior, PreviewPrior], [2]),
    ],
)
def test_everywhere(place, prior_class, execute):
    """Specs hold, warm positions are the mean, the rest is fresh noise, and seeds repeat."""
    prior = prior_class(H)
    env = build(place, prior, cold="noise", execute=execute)
    again = build(place, prior, cold="noise", execute=execute)
    try:
        check_env_specs(env)
        rollouts = []
        for e in (env, again):  # one has been used by the check, the other not
            e.set_seed(5)
            torch.manual_seed(0)
            rollouts.append(e.rollout(9, break_when_any_done=False))
        data, other = rollouts
        assert torch.equal(data["prior", "anchor"], other["prior", "anchor"])
        env.set_seed(6)
        torch.manual_seed(1)
        new = env.rollout(9, break_when_any_done=False)
        assert not torch.equal(new["prior", "anchor"], data["prior", "anchor"])
        for part in (data, data["next"]):
            anchor = part["prior", "anchor"]
            loc, _, centred = prior.distribution(part["history"])
            assert torch.equal(anchor[centred.expand_as(anchor)], loc[centred.expand_as(loc)])
            noise = anchor[~centred.expand_as(anchor)]
            assert len(noise) == len(noise.unique())
            assert len(noise) or (part is not data and prior_class is PastPrior and execute == H)
        # What the agent saw after a step is what it acts around at the next, unless there was a reset.
        alive = ~data["next", "done"][..., :-1, 0]
        after, root = data["next", "prior", "anchor"][..., :-1, :, :], data["prior", "anchor"]
        assert torch.equal(after[alive], root[..., 1:, :, :][alive]) and alive.any()
    finally:
        env.close(raise_if_closed=False)
        again.close(raise_if_closed=False)


class Learned(PastPrior, nn.Module):
    """Warm everywhere, around what a network makes of the observation."""

    name = "learned-of-the-anchor"

    def __init__(self, chunk_length):
        nn.Module.__init__(self)
        super().__init__(chunk_length)
        self.network = nn.Linear(WIDTH, ACTION_DIM)

    def distribution(self, history, observation=None):
        loc = self.network(observation[..., -1:, :]).expand_as(history["forecast"])
        return Source(loc, torch.full_like(loc, 0.5), torch.ones_like(loc[..., :1]).bool())


class Halved(StartPoint):
    """Half-way from noise to the observation."""

    name = "halved-of-the-anchor"
    time = 0.5
    noise_share = 0.4

    def centre(self, history, observation):
        return 0.5 * observation[..., -1:, -ACTION_DIM:].expand_as(history["forecast"]) + 0.25

    def forward(self, noise, history, observation):
        return self.centre(history, observation) + self.noise_share * noise


def observing(actor):
    parts = Compose(ObservationStack(1), *history(actor.prior), PriorAnchor(actor))
    env = TransformedEnv(CountingEnv(LENGTHS[0]), parts)
    check_env_specs(env)
    return env.rollout(3)


def test_a_learned_mean_is_the_anchor_from_the_first_decision_on():
    prior = Learned(H)
    data = observing(actor_for(prior))
    for part in (data, data["next"]):
        mean, _, _ = prior.distribution(part["history"], part["observation"])
        torch.testing.assert_close(part["prior", "anchor"], mean.detach())
        assert mean.any() and not part["prior", "anchor"].requires_grad


@pytest.mark.parametrize("prior_class", PRIORS)
def test_the_anchor_of_a_policy_that_starts_on_the_way_is_the_centre_there(prior_class):
    actor = actor_for(prior_class(H), start=Halved())
    data = observing(actor)
    centre = actor.start.centre(data["history"], data["observation"])
    assert torch.equal(data["prior", "anchor"], centre)
    actor.sampler(data)
    eps = (data["prior", "noise"] - centre - 0.4 * data["prior", "loc"]) / 0.4
    assert data["prior", "noise"].isfinite().all() and 0.2 < eps.std() < 2


def test_a_learned_prior_is_the_anchor_s_own():
    """What moves the environment leaves the policy's weights where they are, and trainable."""
    prior = Learned(H)
    anchor = PriorAnchor(actor_for(prior)).to("meta")
    assert anchor.prior.network.weight.is_meta and not prior.network.weight.is_meta
    assert prior.network.weight.requires_grad and not list(p for p in anchor.parameters() if p.requires_grad)
    paper = PastPrior(H)
    assert PriorAnchor(actor_for(paper)).prior is paper


def test_noise_is_standard_normal():
    prior = PreviewPrior(50)
    env = build("serial-outside", prior)
    torch.manual_seed(0)
    noise = torch.cat([env.reset()["prior", "anchor"].flatten() for _ in range(100)])
    assert abs(float(noise.mean())) < 0.03 and abs(float(noise.std()) - 1) < 0.03


def test_vanilla_dsrl_is_the_default_without_a_mean():
    data = build("single", GaussianPrior(H)).rollout(3)
    assert not data["prior", "anchor"].any() and not data["next", "prior", "anchor"].any()


def test_zero_on_request():
    data = build("single", PreviewPrior(H), cold="zero").rollout(2)["prior", "anchor"]
    assert not data[0].any() and data[1, :H].all() and not data[1, H:].any()


def test_a_partly_collected_history_is_not_an_anchor():
    """Actions are there before the mean is warm: they must not leak into the box's centre."""
    data = build("single", PastPrior(H), execute=2, cold="zero").rollout(2)
    assert data["history", "actions"][1].any() and data["history", "steps"][1] < H
    assert not data["prior", "anchor"][1].any()


def test_one_environment_may_reset_alone():
    env = build("serial-outside", PastPrior(H))
    data = env.step_mdp(env.rand_step(env.reset()))
    kept = data["prior", "anchor"].clone()
    data = env.reset(data.set("_reset", torch.tensor([[True], [False]])))
    assert torch.equal(data["prior", "anchor"][1], kept[1])
    assert not torch.equal(data["prior", "anchor"][0], kept[0])


@pytest.mark.parametrize("prior_class", [PastPrior, PreviewPrior])
@pytest.mark.parametrize("place", ["serial-outside", "serial-inside"])
def test_rows_that_rest_keep_their_anchor(place, prior_class):
    env = build(place, prior_class(H), execute=2)  # not warm after one decision: all of it is noise
    data = env.rand_action(env.reset())
    before = data["prior", "anchor"].clone()
    data["_step"] = torch.tensor([True, False])
    after = env.step(data)["next", "prior", "anchor"]
    assert torch.equal(after[1], before[1])
    assert not torch.isclose(after[0, H - 1], before[0, H - 1]).any()


def test_a_partial_step_without_the_anchor_is_an_error():
    env = build("serial-outside", PastPrior(H))
    data = env.rand_action(env.reset()).exclude(("prior", "anchor"))
    with pytest.raises(KeyError, match="anchor"):
        env.step(data.set("_step", torch.tensor([True, False])))


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_noise_is_of_the_generator_and_leaves_the_global_one():
    expected = torch.randn(H, ACTION_DIM, generator=generator(3))
    env = build("single", PastPrior(H), generator=generator(3))
    state = torch.get_rng_state()
    assert torch.equal(env.reset()["prior", "anchor"], expected)
    assert torch.equal(torch.get_rng_state(), state)


def test_noise_is_of_the_global_generator_without_one():
    env = build("single", PastPrior(H))
    torch.manual_seed(4)
    anchor = env.reset()["prior", "anchor"]
    torch.manual_seed(4)
    assert torch.equal(anchor, torch.randn(H, ACTION_DIM))


@pytest.mark.parametrize("copy_of", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_continues_by_itself(copy_of):
    env = build("single", PastPrior(H), generator=generator())
    twin = copy_of(env)
    drawn = torch.randn(H, ACTION_DIM, generator=generator())
    assert torch.equal(twin.reset()["prior", "anchor"], drawn)
    assert torch.equal(env.reset()["prior", "anchor"], drawn)


def test_in_spawned_workers():
    draws = [generator(i) for i in range(2)]
    workers = [partial(single, PastPrior(H), n, generator=g) for n, g in zip(LENGTHS, draws, strict=True)]
    env = ParallelEnv(2, workers, mp_start_method="spawn")
    try:
        anchor = env.reset()["prior", "anchor"]
        expected = [torch.randn(H, ACTION_DIM, generator=generator(i)) for i in range(2)]
        assert torch.equal(anchor, torch.stack(expected))
    finally:
        env.close()


@pytest.mark.parametrize(
    ("batched", "seeds"),
    [
        (SerialEnv, False),
        (partial(ParallelEnv, mp_start_method="fork"), True),
        (partial(ParallelEnv, mp_start_method="fork", use_buffers=False), False),
    ],
)
def test_what_torchrl_seeds(batched, seeds):
    """The global generators of a ParallelEnv's workers: what the docstring says."""
    env = batched(2, [partial(single, PastPrior(H), n) for n in LENGTHS])
    try:
        env.reset()
        state = torch.get_rng_state()
        env.set_seed(5, static_seed=True)
        assert torch.equal(torch.get_rng_state(), state)
        anchor = env.reset()["prior", "anchor"]
        torch.manual_seed(5)
        expected = torch.randn(H, ACTION_DIM)
        assert all(torch.equal(row, expected) == seeds for row in anchor)
    finally:
        env.close()


def test_in_a_collector():
    collector = Collector(
        build("serial-outside", PreviewPrior(H)), None, frames_per_batch=12, total_frames=24
    )
    collector.set_seed(1)
    for batch in collector:
        loc, _, warm = PreviewPrior(H).distribution(batch["history"])
        warm = warm.expand_as(loc)
        assert torch.equal(batch["prior", "anchor"][warm], loc[warm])
    collector.shutdown()


def test_wrong_places_and_options():
    with pytest.raises(ValueError, match="cold must be 'noise' or 'zero'"):
        PriorAnchor(actor_for(PastPrior(H)), cold="warm")
    bare = TransformedEnv(CountingEnv(5), Compose(ChunkStep(H), PriorAnchor(actor_for(PastPrior(H)))))
    with pytest.raises(KeyError, match="ActionHistory writes it in an environment"):
        bare.reset()
    with pytest.raises(KeyError, match="append it after ActionHistory"):
        bare.observation_spec  # noqa: B018
    with pytest.raises(ValueError, match=r"PreviewPrior.* forecasts of 6, but .* has 3"):
        inside = SerialEnv(1, [lambda: TransformedEnv(CountingEnv(5), Compose(*history(PastPrior(H))))])
        TransformedEnv(inside, PriorAnchor(actor_for(PreviewPrior(H)))).reset()


def test_a_renamed_anchor():
    prior = PastPrior(H)
    anchor = PriorAnchor(actor_for(prior), anchor_key="centre")
    env = TransformedEnv(CountingEnv(7), Compose(*history(prior), anchor))
    check_env_specs(env)
    data = env.rollout(2)
    assert data["centre"].shape == (2, H, ACTION_DIM)
    assert torch.equal(data["centre"][1], data["history", "actions"][1])
