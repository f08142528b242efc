"""Regression and history conditioning as priors, against the same losses and samplers written by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, GymEnv, TransformedEnv

from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    HistoryPrior,
    MeanObservation,
    ObservationStack,
    PastPrior,
    PolynomialInterpolant,
    PreviewPrior,
    Prior,
    RegressionPrior,
    VelocityMLP,
    WarmPriorActor,
    keys,
    policy_transforms,
    window_replay_buffer,
)

H, D_A, D_O, TO = 3, 2, 5, 2


def actor_for(prior, **options):
    torch.manual_seed(3)
    width = D_O + MeanObservation.width(prior, D_A)
    network = VelocityMLP(D_A, width, prior.prediction_length, TO, hidden_dim=16)
    return WarmPriorActor(network, prior, **options)


def windows(prior, seed=0, size=32):
    generator = torch.Generator().manual_seed(seed)
    data = TensorDict(
        {
            "observation": torch.randn(40, D_O, generator=generator),
            "action": torch.randn(40, D_A, generator=generator),
            "episode": torch.arange(40) // 10,
        },
        [40],
    )
    return window_replay_buffer(data, prior, batch_size=size, generator=generator).sample()


def mean_over_unpadded(error, batch):
    return error[~batch["action_is_pad"]].mean()


def test_regression_is_the_mean_squared_error_of_one_evaluation_at_zero():
    prior = RegressionPrior(H)
    actor, batch = actor_for(prior), windows(prior)
    target = batch["vla_action", "chunk"]
    zero = torch.zeros_like(target)
    output = actor.network(torch.zeros(len(batch)), zero, batch["observation"])
    expected = mean_over_unpadded((output - target) ** 2, batch)
    state = torch.get_rng_state()
    loss = FlowMatchingLoss(actor)(batch)["loss_flow_matching"]
    torch.testing.assert_close(loss, expected)
    torch.testing.assert_close(actor(batch.clone())["vla_action", "chunk"], output)
    assert torch.equal(torch.get_rng_state(), state)  # nothing is random


def test_regression_refuses_more_than_one_evaluation():
    prior = RegressionPrior(H)
    with pytest.raises(ValueError, match="at most 1 network evaluation"):
        actor_for(prior, nfe=3)
    with pytest.raises(ValueError, match="at most 1 network evaluation"):
        actor_for(prior)(windows(prior), nfe=9)
    with pytest.raises(ValueError, match="LinearInterpolant"):
        FlowMatchingLoss(actor_for(prior), interpolant=PolynomialInterpolant())
    assert actor_for(prior).ode.nfe == 1
    assert actor_for(GaussianPrior(H)).ode.nfe == 9


def test_history_conditions_the_network_in_training():
    prior = HistoryPrior(H, cold_probability=0.3)
    actor, batch = actor_for(prior), windows(prior)
    warm = batch["prior", "warm"][:, 0, 0]
    assert 0 < warm.sum() < len(batch)
    context = []
    for i in range(len(batch)):
        history = batch["prior", "loc"][i].flatten() if warm[i] else torch.zeros(H * D_A)
        row = torch.cat([history, warm[i : i + 1].float()])
        context.append(torch.stack([torch.cat([o, row]) for o in batch["observation"][i]]))
    generator = torch.Generator().manual_seed(5)
    target = batch["vla_action", "chunk"]
    a0 = torch.randn(target.shape, generator=generator)
    t = torch.rand(len(batch), generator=generator)
    a_t = (1 - t[:, None, None]) * a0 + t[:, None, None] * target
    error = (actor.network(t, a_t, torch.stack(context)) - (target - a0)) ** 2
    loss = FlowMatchingLoss(actor, generator=torch.Generator().manual_seed(5))(batch)
    torch.testing.assert_close(loss["loss_flow_matching"], mean_over_unpadded(error, batch))


def test_history_conditions_the_network_at_decisions_and_not_the_source():
    prior = HistoryPrior(H)
    actor = actor_for(prior, nfe=2, generator=torch.Generator().manual_seed(5))
    data = TensorDict(
        {
            "observation": torch.randn(4, TO, D_O),
            "prior": {
                "loc": torch.randn(4, H, D_A),
                "warm": torch.tensor([True, True, False, False])[:, None, None].expand(4, H, 1),
            },
        },
        [4],
    )
    observe = MeanObservation()
    out = actor(observe(data.clone()))
    noise = torch.randn(4, H, D_A, generator=torch.Generator().manual_seed(5))
    assert torch.equal(out["prior", "noise"], noise)
    other = data.clone()
    other["prior", "loc"] = other["prior", "loc"] + 1.0
    other["prior", "noise"] = noise
    again = actor.ode(observe(other))["vla_action", "chunk"]
    chunk = out["vla_action", "chunk"]
    assert not torch.isclose(again[:2], chunk[:2]).all(-1).any()
    assert torch.equal(again[2:], chunk[2:])  # the mean of a cold sample is not seen
    # Without a batch dimension.
    single = observe(data[0].clone()).set(("prior", "noise"), noise[0])
    torch.testing.assert_close(actor.ode(single)["vla_action", "chunk"], chunk[0])


def test_a_mean_observation_names_the_keys_it_lacks():
    data = TensorDict({"observation": torch.zeros(1, TO, D_O)}, [1])
    with pytest.raises(KeyError, match=r"MeanObservation needs .*missing: .*'loc'.*'warm'"):
        MeanObservation()(data)
    with pytest.raises(KeyError, match=r"missing: \[\('prior', 'observation'\)\]"):
        actor_for(HistoryPrior(H))(windows(PastPrior(H)))


def test_a_mean_observation_without_a_mean_in_an_environment():
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(ObservationStack(2), MeanObservation()))
    with pytest.raises(KeyError, match=r"missing: .*'loc'.*append it after ActionHistory"):
        _ = env.observation_spec


def test_a_half_warm_mean_counts_as_history():
    class Conditioned(PreviewPrior):
        conditions_network = True

    prior = Conditioned(H)
    assert MeanObservation.width(prior, D_A) == 2 * H * D_A + 1
    batch = windows(prior)
    out = batch[keys.CONDITIONED]
    assert out.shape == (32, TO, D_O + MeanObservation.width(prior, D_A))
    assert torch.equal(out[..., :D_O], batch["observation"])
    assert (out[..., -1] == 1).all() and not out[..., -1 - H * D_A : -1].any()


@pytest.mark.parametrize("prior_class", [GaussianPrior, PastPrior, PreviewPrior, RegressionPrior])
def test_other_priors_leave_the_observation_alone(prior_class):
    prior = prior_class(H)
    assert MeanObservation.width(prior, D_A) == 0
    assert keys.CONDITIONED not in windows(prior).keys(True)
    assert actor_for(prior).in_keys[0] == "observation"


@pytest.mark.parametrize("new", [RegressionPrior(H), HistoryPrior(H), PastPrior(H)])
@pytest.mark.parametrize("old", [RegressionPrior(H), HistoryPrior(H), PastPrior(H)])
def test_another_prior_brings_its_own_defaults(old, new):
    network = actor_for(new).network
    found = WarmPriorActor(network, old).replace(prior=new)
    expected = WarmPriorActor(network, new)
    assert (found.in_keys, found.ode.nfe) == (expected.in_keys, expected.ode.nfe)
    # What was chosen stays.
    found = WarmPriorActor(network, PastPrior(H), nfe=4, observation_key="state").replace(
        prior=HistoryPrior(H)
    )
    assert (found.in_keys[0], found.ode.nfe) == ("state", 4)


@pytest.mark.parametrize("prior_class", [RegressionPrior, HistoryPrior])
def test_saved_and_loaded_policies_act_alike(prior_class, tmp_path):
    prior = prior_class(H)
    assert Prior.from_config(prior.config()).config() == prior.config()
    actor = actor_for(prior, generator=torch.Generator().manual_seed(1))
    actor.save_pretrained(tmp_path)
    loaded = WarmPriorActor.from_pretrained(tmp_path, generator=torch.Generator().manual_seed(1))
    assert type(loaded.prior) is prior_class and loaded.ode.nfe == actor.ode.nfe
    batch = windows(prior)
    chunks = [a(batch.clone())["vla_action", "chunk"] for a in (actor, loaded)]
    assert torch.equal(*chunks)


@pytest.mark.parametrize("prior_class", [RegressionPrior, HistoryPrior])
def test_rollout_in_an_environment(prior_class):
    prior = prior_class(4)
    network = VelocityMLP(1, 3 + MeanObservation.width(prior, 1), 4, hidden_dim=8)
    env = TransformedEnv(GymEnv("Pendulum-v1"), policy_transforms(prior))
    rollout = env.rollout(3, WarmPriorActor(network, prior))
    assert rollout["prior", "warm"].all(1).flatten().tolist() == (
        [False, True, True] if prior_class is HistoryPrior else [False] * 3
    )
