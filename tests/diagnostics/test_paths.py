from __future__ import annotations

import torch

from tests.diagnostics.fields import D_A, Field, H, batch, policy, remember
from warmprior import PastPrior, PreviewPrior, RealTimeChunking, WarmPriorActor
from warmprior.diagnostics.curvature import flow_paths
from warmprior.diagnostics.flow import deployed_history


def test_paths_start_at_the_source_and_follow_euler():
    generator = torch.Generator().manual_seed(4)
    field = policy(lambda t, a, o: o[..., :D_A] - a)
    data = batch(6).reshape(2, 3)
    path = flow_paths(field, data, 10, generator=generator)
    assert path.shape == (2, 3, 11, H, D_A)
    a0 = torch.randn(6, H, D_A, generator=torch.Generator().manual_seed(4)).view(2, 3, H, D_A)
    assert torch.equal(path[:, :, 0], a0)
    goal = data["observation"][..., :D_A]
    expected = [goal + (a0 - goal) * 0.9**k for k in range(11)]
    torch.testing.assert_close(path, torch.stack(expected, 2))


def test_forecast_is_the_previous_prediction():
    """A field that carries every source to the positions 0, 1, 2, ... predicts exactly these."""
    prior = PreviewPrior(H, sigma=0.1)

    def field(t, a, o):
        goal = torch.arange(2.0 * H).view(1, -1, 1)
        return (goal - a) / (1 - t).clamp_min(1e-6)

    out = deployed_history(policy(field, prior), batch(length=2 * H))
    source = prior.distribution(out["history"])
    loc, warm = source.loc, source.warm
    expected = torch.arange(H, 2 * H).float()
    torch.testing.assert_close(loc[:, :H, 0], expected.expand(5, -1))
    assert warm[:, :H].all() and not warm[:, H:].any()


def test_after_a_whole_chunk_the_history_is_full():
    actor = policy(lambda t, a, o: -a, PastPrior(H))
    assert (deployed_history(actor, batch())["history", "steps"] == H).all()


def test_the_forecast_of_a_guided_policy_is_what_it_would_do():
    """With its source's own sigma in the guidance, which is not 1."""
    prior = PastPrior(H, sigma=0.5)
    field = Field(lambda t, a, o: a.sin())
    actor = WarmPriorActor(field, prior, nfe=4, guidance=RealTimeChunking())
    data = remember(batch(rtc={"delay": torch.ones(5, 1, dtype=torch.int64)}), torch.rand(5, H, D_A))
    found = deployed_history(actor, data, generator=torch.Generator().manual_seed(0))
    acted = actor(data.clone(), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(found["history", "actions"], acted["vla_action", "chunk"].detach())
