"""The L1 objective and self-distillation: written down by hand, and what they make of two modes."""

import copy

import pytest
import torch

from tests.errors import raises
from tests.objectives.test_flow_matching import actor_for, loss_of, sample
from tests.paths import PolynomialInterpolant
from warmprior import FlowMatchingLoss, GaussianPrior, PastPrior, PreviewPrior, SelfDistillationLoss
from warmprior.modules import StartPoint
from warmprior.training import TrainingConfig

H = 3
PRIORS = [GaussianPrior(H), PastPrior(H, sigma=0.4), PreviewPrior(H)]


class Late(StartPoint):
    """Samplers enter the flow on the way."""

    name = "late-of-the-tests"
    time, noise_share = 0.4, 0.6


def distilled(actor, data, **options):
    generator = torch.Generator().manual_seed(2)
    return SelfDistillationLoss(actor, generator=generator, **options)(data)["loss_self_distillation"]


def ends(prior, data):
    """The source and target that the loss draws first, and the times after them."""
    generator = torch.Generator().manual_seed(2)
    a0 = prior.sample(data["history"], generator=generator)
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


@pytest.mark.parametrize("start", [None, Late()])
@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: prior.name)
@pytest.mark.parametrize("objective", ["velocity", "l1"])
def test_self_distillation_by_hand(prior, objective, start):
    """One step to where one of the data's and eight of the teacher's lead, of the first quarter."""
    actor, data = actor_for(prior, start=start), sample(prior, 12)
    teacher = copy.deepcopy(actor.network)
    with torch.no_grad():
        for p in teacher.parameters():
            p.add_(0.05 * torch.randn_like(p))
    a0, a1, _ = ends(prior, data)
    s, n = 0.4 if start else 0.0, 3
    begin = (1 - s) * a0[:n] + s * a1[:n]
    h = (1 - s) / 9
    observation = data["observation"][:n]
    a = begin + h * (a1 - a0)[:n]
    with torch.no_grad():
        for k in range(1, 9):
            a = a + h * teacher(torch.full((n,), s + k * h), a, observation)
    jump = actor.network(torch.full((n,), s), begin, observation)
    if objective == "l1":
        errors = (begin + (1 - s) * jump - a).abs()
    else:
        errors = (jump - (a - begin) / (1 - s)).square()
    counted = ~data["action_is_pad"][:n]
    expected = errors[counted].mean()
    gradients = torch.autograd.grad(expected, list(actor.network.parameters()))

    options = {"objective": objective, "teacher": teacher}
    loss = distilled(actor, data, **options)
    torch.testing.assert_close(loss, expected, rtol=1e-4, atol=1e-6)
    loss.backward()
    for parameter, gradient in zip(actor.network.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-6)
    assert all(p.grad is None for p in teacher.parameters())
    unreduced = distilled(actor, data, reduction="none", **options)
    torch.testing.assert_close(unreduced, errors * counted[..., None], rtol=1e-4, atol=1e-5)


def test_without_a_teacher_the_network_teaches_itself_and_no_gradient_flows_back():
    prior = PastPrior(H)
    actor, data = actor_for(prior), sample(prior, 12)
    own, twin = distilled(actor, data), distilled(actor, data, teacher=copy.deepcopy(actor.network))
    assert torch.equal(own, twin)
    parameters = list(actor.network.parameters())
    gradients = (torch.autograd.grad(loss, parameters) for loss in (own, twin))
    assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


def test_bad_options():
    actor = actor_for(PastPrior(H))
    with raises(ValueError, "objective", "velocity, l1", "'l2'"):
        FlowMatchingLoss(actor, objective="l2")
    with raises(ValueError, "PolynomialInterpolant"):
        FlowMatchingLoss(actor, objective="l1", interpolant=PolynomialInterpolant())


@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: prior.name)
def test_regression_is_the_error_of_one_step_from_the_source(prior):
    actor, data = actor_for(prior, max_nfe=1), sample(prior, 10)
    a0, a1, _ = ends(prior, data)
    reached = a0 + actor.network(torch.zeros(10), a0, data["observation"])
    expected = (reached - a1).square()[~data["action_is_pad"]].mean()
    torch.testing.assert_close(loss_of(actor, data, times="start"), expected)
    chunk = actor(data, generator=torch.Generator().manual_seed(2))["vla_action", "chunk"]
    torch.testing.assert_close(chunk, reached)


def test_regression_has_no_flow():
    actor = actor_for(PastPrior(H), max_nfe=1)
    with raises(ValueError, "t = 0"):
        SelfDistillationLoss(actor)
    with raises(ValueError, "self_distillation", "'start'"):
        TrainingConfig(times="start", self_distillation=0.5)
    with raises(ValueError, "self_distillation", 0):
        TrainingConfig(self_distillation=-1.0)
    with raises(ValueError, "max_nfe=1"):
        FlowMatchingLoss(actor_for(PastPrior(H)), times="start")
    with raises(ValueError, "LinearInterpolant", "PolynomialInterpolant"):
        FlowMatchingLoss(actor, times="start", interpolant=PolynomialInterpolant())
