"""Curvature against fields whose paths are known in closed form."""

import warnings

import pytest
import torch

from tests.diagnostics.fields import D_A, H, batch, policy, remember
from tests.errors import refuses
from warmprior import PastPrior, PreviewPrior
from warmprior.diagnostics import curvature


@pytest.mark.parametrize("n_steps", [10, 100])
def test_a_linear_field_has_the_closed_form(n_steps):
    """v = -a: v_k = -(1 - 1/N)^k a0 at step k, coordinate by coordinate."""
    prior = PastPrior(H, sigma=0.0)  # the source is the mean itself
    data = batch()
    mean = torch.randn(5, H, D_A)
    remember(data, mean)
    out = curvature(policy(lambda t, a, o: -a, prior), data, n_steps)
    length = mean.double().square().sum((-1, -2))
    factors = (1 - 1 / n_steps) ** torch.arange(n_steps, dtype=torch.float64)
    gap = (1 - 1 / n_steps) ** n_steps  # one step ends at 0, the path at this share of a0
    expected = {"kappa": length * factors.var(correction=0), "speed": length * factors.mean() ** 2}
    expected["one_step_error"] = (length / (H * D_A)).sqrt() * gap
    for name, value in expected.items():
        torch.testing.assert_close(out[name].double(), value, rtol=1e-4, atol=1e-6)


def test_executed_positions_and_padding_count_separately():
    """Speed p at position p: sums over the counted positions only."""
    prior = PreviewPrior(H)
    weights = torch.arange(1.0, 2 * H + 1).view(1, -1, 1)
    data = batch(length=2 * H)
    pad = torch.zeros(5, 2 * H, dtype=torch.bool)
    pad[0, 2:] = True
    out = curvature(policy(lambda t, a, o: weights.expand_as(a), prior), data)
    assert out["speed"][1] == pytest.approx(D_A * sum(p * p for p in range(1, 2 * H + 1)))
    assert out["speed_executed"][1] == pytest.approx(D_A * (1 + 4 + 9))
    data["action_is_pad"] = pad.long()  # numbers, as some files have them
    out = curvature(policy(lambda t, a, o: weights.expand_as(a), prior), data)
    assert out["speed"].tolist() == pytest.approx([D_A * 5.0] + [D_A * 91.0] * 4)
    assert out["speed_executed"].tolist() == pytest.approx([D_A * 5.0] + [D_A * 14.0] * 4)


def test_a_field_that_has_not_learnt_to_move_is_flagged_with_targets():
    """A little noise around zero velocity, on the first half of WP-Preview only."""
    prior = PreviewPrior(H, sigma=0.1)
    n = 40
    target = torch.randn(n, 2 * H, D_A, generator=torch.Generator().manual_seed(0))
    data = batch(n, length=2 * H)
    remember(data, target)
    data["vla_action", "chunk"] = target

    def lazy(t, a, o):  # first half nearly still, second half optimal for normal data
        optimal = (2 * t - 1) / ((1 - t) ** 2 + t**2) * a[:, H:]
        return torch.cat([0.01 * torch.sin(9 * t) + 0 * a[:, :H], optimal], 1)

    with pytest.warns(UserWarning, match="executed"):
        out = curvature(policy(lazy, prior), data)
    assert out["kappa_executed"].isnan().all() and out["relative_executed"].isnan().all()
    assert torch.isfinite(out["kappa"]).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prediction = data.clone().set(("prior", "noise"), target)  # as in a rollout: no target
        assert torch.isfinite(curvature(policy(lazy, prior), prediction)["kappa_executed"]).all()
        assert torch.isfinite(curvature(policy(lazy, prior), data.exclude("vla_action"))["kappa"]).all()


def test_bad_options_and_policies_are_named():
    field = policy(lambda t, a, o: -a)
    refuses(lambda: curvature(field, batch(), 1), ValueError, "n_steps", 2, 1)
    refuses(lambda: curvature(policy(lambda t, a, o: -a, max_nfe=1), batch()), ValueError, 1, 100)

    def explodes(t, a, o):
        return torch.where((torch.arange(len(a)) == 2).view(-1, 1, 1), a * torch.inf, -a)

    refuses(lambda: curvature(policy(explodes), batch()), FloatingPointError, "1 of 5", "observation 2")
