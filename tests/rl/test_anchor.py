from functools import partial

import pytest
import torch
from torch import nn
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import raises
from tests.toy_env import ACTION_DIM, PLACES, CountingEnv, Halfway, closing, mlp_actor, placed
from warmprior import (
    ActionHistory,
    ChunkStep,
    GaussianPrior,
    ObservationStack,
    PastPrior,
    PreviewPrior,
    PriorAnchor,
)
from warmprior.modules.source import Source

H = 3
LENGTHS = (7, 4)
PRIORS = [GaussianPrior, PastPrior, PreviewPrior]
actor_for = partial(mlp_actor, steps=1)


def history(prior, execute=None):
    chunk = ChunkStep(prior.chunk_length, execute=execute, prediction_length=prior.prediction_length)
    return [chunk, ActionHistory(prior.history_length)]


def build(place, prior, execute=None):
    def transforms():
        return Compose(*history(prior, execute), PriorAnchor(actor_for(prior)))

    return placed(place, transforms, LENGTHS)


@pytest.mark.parametrize(
    ("place", "prior_class", "execute"),
    [
        *((place, PreviewPrior, 2) for place in PLACES),
        *(("serial-outside", PastPrior, execute) for execute in (H, 2)),
    ],
)
def test_everywhere(place, prior_class, execute):
    prior = prior_class(H)
    env, again = (build(place, prior, execute=execute) for _ in range(2))
    with closing(env), closing(again):
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
            source = prior.distribution(part["history"])
            loc, centred = source.loc, source.warm
            assert torch.equal(anchor[centred.expand_as(anchor)], loc[centred.expand_as(loc)])
            noise = anchor[~centred.expand_as(anchor)]
            assert len(noise) == len(noise.unique())
            assert len(noise) or (part is not data and prior_class is PastPrior and execute == H)
        # What the agent saw after a step is what it acts around at the next, unless there was a reset.
        alive = ~data["next", "done"][..., :-1, 0]
        after, root = data["next", "prior", "anchor"][..., :-1, :, :], data["prior", "anchor"]
        assert torch.equal(after[alive], root[..., 1:, :, :][alive]) and alive.any()


class Learned(PastPrior, nn.Module):
    """Warm everywhere, around what a network makes of the observation."""

    name = "learned-of-the-anchor"

    def __init__(self, chunk_length):
        nn.Module.__init__(self)
        super().__init__(chunk_length)
        self.network = nn.Linear(2 + ACTION_DIM, ACTION_DIM)

    def distribution(self, history, observation=None):
        loc = self.network(observation[..., -1:, :]).expand_as(history["forecast"])
        return Source(loc, torch.full_like(loc, 0.5), torch.ones_like(loc[..., :1]).bool())


class Seeing(Halfway):
    """The observation counts too."""

    name = "seeing-of-the-anchor"

    def centre(self, history, observation):
        return super().centre(history, observation) + observation[..., -1:, -ACTION_DIM:]


def observing(actor):
    parts = Compose(ObservationStack(1), *history(actor.prior), PriorAnchor(actor))
    env = TransformedEnv(CountingEnv(LENGTHS[0]), parts)
    check_env_specs(env)
    return env.rollout(3)


def test_a_learned_mean_is_the_anchor_from_the_first_decision_on():
    prior = Learned(H)
    data = observing(actor_for(prior))
    for part in (data, data["next"]):
        mean = prior.distribution(part["history"], part["observation"]).loc
        torch.testing.assert_close(part["prior", "anchor"], mean.detach())
        assert mean.any() and not part["prior", "anchor"].requires_grad


@pytest.mark.parametrize("prior_class", PRIORS)
def test_the_anchor_of_a_policy_that_starts_on_the_way_is_the_centre_there(prior_class):
    actor = actor_for(prior_class(H), start=Seeing(0.25))
    data = observing(actor)
    last, seen = data["history", "actions"][..., -1:, :], data["observation"][..., -1:, -ACTION_DIM:]
    centre = (last + 0.25 + seen).expand_as(data["history", "forecast"])
    assert torch.equal(data["prior", "anchor"], centre)
    actor.sampler(data)
    eps = (data["prior", "noise"] - centre - 0.5 * data["prior", "loc"]) / 0.5
    assert data["prior", "noise"].isfinite().all() and 0.2 < eps.std() < 2


def test_a_partly_collected_history_is_not_an_anchor():
    """Actions are there before the mean is warm: they must not leak into the box's centre."""
    data = build("single", PastPrior(H), execute=2).rollout(2)
    actions = data["history", "actions"][1]
    assert actions.any() and data["history", "steps"][1] < H
    assert not torch.isclose(data["prior", "anchor"][1], actions).any()
    assert not build("single", GaussianPrior(H)).rollout(2)["prior", "anchor"].any()


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


def test_wrong_places():
    bare = TransformedEnv(CountingEnv(5), Compose(ChunkStep(H), PriorAnchor(actor_for(PastPrior(H)))))
    with raises(KeyError, "ActionHistory"):
        bare.reset()
    with raises(KeyError, "ActionHistory"):
        bare.observation_spec  # noqa: B018
    with raises(ValueError, "PreviewPrior", 6, 3):
        inside = SerialEnv(1, [lambda: TransformedEnv(CountingEnv(5), Compose(*history(PastPrior(H))))])
        TransformedEnv(inside, PriorAnchor(actor_for(PreviewPrior(H)))).reset()
