"""The L1 objective and regression, written down by hand."""

import pytest
import torch

from tests.errors import raises, refuses
from tests.objectives.test_flow_matching import actor_for, loss_of, sample
from tests.paths import PolynomialInterpolant
from warmprior import FlowMatchingLoss, GaussianPrior, PastPrior, PreviewPrior

H = 3
PRIORS = [GaussianPrior(H), PastPrior(H, sigma=0.4), PreviewPrior(H)]


def ends(prior, data):
    """The source and target that the loss draws first, and the times after them."""
    generator = torch.Generator().manual_seed(2)
    a0 = prior.distribution(data["history"]).sample(generator)
    return a0, data["vla_action", "chunk"], torch.rand(len(data), generator=generator)


@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: prior.name)
def test_l1_compares_predicted_samples(prior):
    actor, data = actor_for(prior), sample(prior, 10)
    a0, a1, times = ends(prior, data)
    t = times[:, None, None]
    a_t = (1 - t) * a0 + t * a1
    errors = (a_t + (1 - t) * actor.network(times, a_t, data["observation"]) - a1).abs()
    counted = ~data["action_is_pad"]
    torch.testing.assert_close(loss_of(actor, data, objective="l1"), errors[counted].mean())
    unreduced = loss_of(actor, data, objective="l1", reduction="none")
    torch.testing.assert_close(unreduced, errors * counted[..., None])


def test_bad_options():
    actor = actor_for(PastPrior(H))
    refuses(lambda: FlowMatchingLoss(actor, objective="l2"), ValueError, "objective", "velocity, l1", "'l2'")
    with raises(ValueError, "PolynomialInterpolant"):
        FlowMatchingLoss(actor, objective="l1", interpolant=PolynomialInterpolant())
    refuses(lambda: FlowMatchingLoss(actor, times="start"), ValueError, "max_nfe=1")
    single = actor_for(PastPrior(H), max_nfe=1)
    with raises(ValueError, "LinearInterpolant", "PolynomialInterpolant"):
        FlowMatchingLoss(single, times="start", interpolant=PolynomialInterpolant())


@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: prior.name)
def test_regression_is_the_error_of_one_step_from_the_source(prior):
    actor, data = actor_for(prior, max_nfe=1), sample(prior, 10)
    a0, a1, _ = ends(prior, data)
    reached = a0 + actor.network(torch.zeros(10), a0, data["observation"])
    expected = (reached - a1).square()[~data["action_is_pad"]].mean()
    torch.testing.assert_close(loss_of(actor, data, times="start"), expected)
    chunk = actor(data, generator=torch.Generator().manual_seed(2))["vla_action", "chunk"]
    torch.testing.assert_close(chunk, reached)
