import torch

from tests.diagnostics.fields import D_A, Field, H, batch, policy, remember
from warmprior import PastPrior, RealTimeChunking, WarmPriorActor
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


def test_the_forecast_of_a_guided_policy_is_what_it_would_do():
    """With its source's own sigma in the guidance, which is not 1."""
    prior = PastPrior(H, sigma=0.5)
    field = Field(lambda t, a, o: a.sin())
    actor = WarmPriorActor(field, prior, nfe=4, guidance=RealTimeChunking())
    data = remember(batch(rtc={"delay": torch.ones(5, 1, dtype=torch.int64)}), torch.rand(5, H, D_A))
    found = deployed_history(actor, data, generator=torch.Generator().manual_seed(0))
    acted = actor(data.clone(), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(found["history", "actions"], acted["vla_action", "chunk"].detach())
