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
    chunk = ChunkStep(
        prior.chunk_length, execute=execute, prediction_length=prior.prediction_length
    )
    return [chunk, ActionHistory(prior.history_length)]


def anchored(env, prior, execute=None, **options):
    return TransformedEnv(
        env, Compose(*history(prior, execute), PriorAnchor(actor_for(prior), **options))
    )


def single(prior, length, **options):
    return anchored(CountingEnv(length), prior, **options)


def build(place, prior, **options):
    if place == "single":
        return single(prior, LENGTHS[0], **options)
    batched = SerialEnv if "serial" in place else partial(ParallelEnv, mp_start_method="fork")
    if place.endswith("outside"):
        return anchored(batched(2, [partial(CountingEnv, n) for n in LENGTHS]), prior, **options)
    workers = [partial(single, prior, n, seed_offset=i, **options) for i, n in enumerate(LENGTHS)]
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
        torch.manual_seed(0)
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
    assert prior.network.weight.requires_grad and not list(
        p for p in anchor.parameters() if p.requires_grad
    )
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


def test_workers_with_one_seed_differ_by_offset():
    env = build("serial-inside", PastPrior(H))
    env.set_seed(3, static_seed=True)
    first, second = env.reset()["prior", "anchor"]
    assert not torch.equal(first, second)


@pytest.mark.parametrize("batched", [partial(ParallelEnv, mp_start_method="fork"), SerialEnv])
def test_unseeded_environments_differ(batched):
    """Forked workers begin with one state of PyTorch's generator."""
    env = batched(2, [partial(single, PastPrior(H), n) for n in LENGTHS])
    try:
        first, second = env.reset()["prior", "anchor"]
        assert not torch.equal(first, second)
    finally:
        env.close()


def test_an_unseeded_anchor_follows_the_global_generator():
    anchors = []
    for _ in range(2):
        torch.manual_seed(4)
        anchors.append(build("single", PastPrior(H)).reset()["prior", "anchor"])
    assert torch.equal(*anchors)


def test_global_generator_is_not_used_after_a_seed():
    env = build("single", PastPrior(H), seed=0)
    torch.manual_seed(0)
    state = torch.get_rng_state()
    env.reset()
    assert torch.equal(torch.get_rng_state(), state)


def test_set_seed_still_returns_the_next_seed():
    env = build("serial-outside", PastPrior(H))
    base = SerialEnv(2, [partial(CountingEnv, n) for n in LENGTHS])
    assert env.set_seed(3) == base.set_seed(3)
    assert env.set_seed(3, static_seed=True) == 3


def test_nested_and_extended_environments_are_seeded():
    anchors = []
    for wrap in (False, True):
        env = build("serial-outside", PastPrior(H))
        if wrap:
            env = TransformedEnv(env, Compose(), auto_unwrap=False)
        env.set_seed(8)
        anchors.append(env.reset()["prior", "anchor"])
    late = TransformedEnv(SerialEnv(2, [partial(CountingEnv, n) for n in LENGTHS]))
    for transform in (*history(PastPrior(H)), PriorAnchor(actor_for(PastPrior(H)))):
        late.append_transform(transform)
    late.set_seed(8)
    anchors.append(late.reset()["prior", "anchor"])
    assert torch.equal(anchors[0], anchors[1]) and torch.equal(anchors[0], anchors[2])


def test_every_anchor_of_an_environment_is_seeded():
    prior = PastPrior(H)
    anchors = [PriorAnchor(actor_for(prior), seed_offset=i, anchor_key=str(i)) for i in range(2)]
    env = TransformedEnv(CountingEnv(7), Compose(*history(prior), *anchors))
    env.set_seed(4)
    first = env.reset()
    env.set_seed(4)
    again = env.reset()
    assert torch.equal(first["0"], again["0"]) and torch.equal(first["1"], again["1"])
    assert not torch.equal(first["0"], first["1"])


def test_a_detached_anchor_hears_no_seed():
    env = build("single", PastPrior(H))
    env.set_seed(4)
    expected = env.reset()["prior", "anchor"]
    env.set_seed(4)
    anchor = env.transform[-1]
    env.transform = Compose(*history(PastPrior(H)))
    assert env.set_seed(5) == CountingEnv(LENGTHS[0]).set_seed(5)
    env.append_transform(anchor)
    assert torch.equal(env.reset()["prior", "anchor"], expected)


@pytest.mark.parametrize("copy_of", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_is_seeded_by_itself(copy_of):
    env = build("single", PastPrior(H))
    env.set_seed(4)
    expected = env.reset()["prior", "anchor"]
    env.set_seed(4)
    twin = copy_of(env)
    twin.set_seed(5)
    assert not torch.equal(twin.reset()["prior", "anchor"], expected)
    assert torch.equal(env.reset()["prior", "anchor"], expected)
    del env
    twin.set_seed(4)
    assert torch.equal(twin.reset()["prior", "anchor"], expected)


def test_a_clone_draws_by_itself():
    """Transforms are cloned into evaluation environments: what these draw must not reach the training."""
    env = build("single", PastPrior(H))
    env.set_seed(4)
    expected = env.reset()["prior", "anchor"]
    env.set_seed(4)
    twin = TransformedEnv(CountingEnv(LENGTHS[0]), env.transform.clone())
    assert torch.equal(twin.reset()["prior", "anchor"], expected)  # it goes on from the same state
    twin.set_seed(5)
    assert not torch.equal(twin.reset()["prior", "anchor"], expected)
    assert torch.equal(env.reset()["prior", "anchor"], expected)


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
    bare = TransformedEnv(
        CountingEnv(5), Compose(ChunkStep(H), PriorAnchor(actor_for(PastPrior(H))))
    )
    with pytest.raises(KeyError, match="ActionHistory writes it in an environment"):
        bare.reset()
    with pytest.raises(KeyError, match="append it after ActionHistory"):
        bare.observation_spec  # noqa: B018
    with pytest.raises(ValueError, match=r"PreviewPrior.* forecasts of 6, but .* has 3"):
        inside = SerialEnv(
            1, [lambda: TransformedEnv(CountingEnv(5), Compose(*history(PastPrior(H))))]
        )
        TransformedEnv(inside, PriorAnchor(actor_for(PreviewPrior(H)))).reset()


def test_a_renamed_anchor():
    prior = PastPrior(H)
    anchor = PriorAnchor(actor_for(prior), anchor_key="centre")
    env = TransformedEnv(CountingEnv(7), Compose(*history(prior), anchor))
    check_env_specs(env)
    data = env.rollout(2)
    assert data["centre"].shape == (2, H, ACTION_DIM)
    assert torch.equal(data["centre"][1], data["history", "actions"][1])
