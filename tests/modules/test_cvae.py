"""The decoder of a CVAE as a source: its loss by hand, and its draws on data whose answer is known."""

import torch
from tensordict import TensorDict

from tests.errors import raises
from tests.toy_env import random_history
from warmprior import CVAEPrior, Prior, window_replay_buffer
from warmprior.modules.learning import minimise
from warmprior.modules.registry import from_config

H, D_A, D_O = 2, 1, 2


def prior_for(**options):
    torch.manual_seed(0)
    return CVAEPrior(H, widths=[D_A, D_O, 1], **options)


def test_it_draws_what_the_data_hold():
    """Two modes at one observation: the decoder's draws have both, and nothing between."""
    generator = torch.Generator().manual_seed(0)
    side = torch.randint(2, (200,), generator=generator).repeat_interleave(10).float()
    episode, modes = torch.arange(200).repeat_interleave(10), (2 * side - 1)[:, None] * 0.8
    data = {"observation": torch.zeros(2000, D_O), "action": modes, "episode": episode}
    prior = prior_for(hidden_dim=32, sigma=0.0, latent_dim=2)
    windows = window_replay_buffer(
        TensorDict(data, [2000]), prior, batch_size=256, observation_steps=1, generator=generator
    )
    recipe = {"iterations": 800, "generator": generator, "learning_rate": 1e-2}
    minimise(prior.learning_loss, prior, windows, **recipe)
    history = random_history(prior, 500, action_dim=D_A)
    with torch.no_grad():
        source = prior.distribution(history, torch.zeros(500, 1, D_O))
        drawn, middle = source.sample(generator)[:, 0, 0], source.sample(temperature=0.0)
    assert not source.warm.any()  # no Gaussian, so agents search around zero
    near = [(drawn - mode).abs() < 0.25 for mode in (-0.8, 0.8)]
    assert all(0.25 < float(n.float().mean()) < 0.75 for n in near)
    assert float((near[0] | near[1]).float().mean()) > 0.75
    torch.testing.assert_close(middle, middle[:1].expand_as(middle))  # decodes the mean latent everywhere


def test_the_loss_is_its_equation():
    """With positions past the end of an episode, which are neither encoded nor predicted."""
    prior = prior_for(hidden_dim=8, latent_dim=3, beta=0.7)
    g = torch.Generator().manual_seed(0)
    a1, seen = torch.randn(5, H, D_A, generator=g), torch.randn(5, 1, D_O, generator=g)
    for inside in (torch.ones(5, H, 1), torch.tensor([[1.0, 1], [1, 0], [1, 1], [1, 0], [1, 1]])[..., None]):
        windows = {"vla_action": {"chunk": a1}, "action_is_pad": inside[..., 0] == 0, "observation": seen}
        found = prior.learning_loss(TensorDict(windows, [5]), torch.Generator().manual_seed(1))
        code = prior.encoder(torch.cat([seen.flatten(1), (a1 * inside).flatten(1)], -1))
        mean, deviation = code[:, :3], (0.5 * code[:, 3:]).exp()
        z = mean + deviation * torch.randn(5, 3, generator=torch.Generator().manual_seed(1))
        error = a1 - prior.decoder(torch.cat([seen.flatten(1), z], -1)).view_as(a1)
        q, standard = torch.distributions.Normal(mean, deviation), torch.distributions.Normal(0.0, 1.0)
        divergence = torch.distributions.kl_divergence(q, standard).sum(-1).mean()
        expected = error[inside == 1].square().mean() + 0.7 * 3 / (H * D_A) * divergence
        torch.testing.assert_close(found, expected)


def test_a_draw_is_its_equation():
    prior = prior_for(hidden_dim=8, latent_dim=3, sigma=0.3)
    seen = torch.randn(4, 1, D_O)
    source = prior.distribution(random_history(prior, 4, action_dim=D_A), seen)
    for temperature in (1.0, 0.5):
        generator = torch.Generator().manual_seed(2)
        z, eps = (torch.randn(*shape, generator=generator) for shape in ((4, 3), (4, H, D_A)))
        decoded = prior.decoder(torch.cat([seen.flatten(1), temperature * z], -1)).view(4, H, D_A)
        found = source.sample(torch.Generator().manual_seed(2), temperature)
        torch.testing.assert_close(found, decoded + temperature * 0.3 * eps)


def test_it_is_built_from_its_configuration_and_only_what_it_can_read_is_read():
    prior = prior_for(hidden_dim=8)
    again = from_config(Prior, prior.config())
    assert repr(again) == repr(prior) and again.state_dict().keys() == prior.state_dict().keys()
    assert not any(p.requires_grad for p in again.parameters())
    history = random_history(prior, 3, action_dim=D_A)
    with raises(ValueError, "CVAEPrior", [3, 2, D_O], f"[3, 1, {D_O}]"):
        prior.distribution(history, torch.zeros(3, 2, D_O))
    for one, seen in ((prior, None), (CVAEPrior(H), torch.zeros(3, 1, D_O))):
        with raises(ValueError, "CVAEPrior", "train_policy"):
            one.distribution(history, seen)
    for option in ("latent_dim", "hidden_dim", "beta"):
        with raises(ValueError, option, 0):
            CVAEPrior(H, **{option: 0})


def test_data_of_another_precision_are_cast():
    prior = prior_for(hidden_dim=8)
    history = random_history(prior, 3, action_dim=D_A).apply(
        lambda x: x.double() if x.is_floating_point() else x
    )
    with torch.no_grad():
        source = prior.distribution(history, torch.zeros(3, 1, D_O, dtype=torch.float64))
        assert source.sample().dtype == source.loc.dtype == torch.float64
    data = {"observation": torch.rand(20, D_O).double(), "action": torch.rand(20, D_A).double()}
    steps = TensorDict({**data, "episode": torch.arange(20) // 10}, [20])
    windows = window_replay_buffer(steps, prior, batch_size=8, observation_steps=1)
    assert prior.learning_loss(windows.sample()).isfinite()
