"""Sources that learn before the flow: what they learn, on data whose answer is known."""

import pytest
import torch
from tensordict import TensorDict

from lab.methods.learned_sources import A2APrior, CVAEHistoryPrior, ForecastPrior, ForecastStart, LeapPrior
from tests.toy_env import random_history
from warmprior import GaussianPrior, window_replay_buffer, window_transforms
from warmprior.modules import Prior
from warmprior.modules.learning import minimise
from warmprior.modules.registry import from_config

H, D_A, D_O = 2, 1, 2
NOISE = 0.3


def demonstrations(episodes=60, steps=40, seed=0):
    """``a[i] = o[i, 0] + noise``, with one observation per half episode; the second entry says nothing."""
    generator = torch.Generator().manual_seed(seed)
    level = torch.rand(episodes, 2, generator=generator).repeat_interleave(steps // 2, 1) - 0.5
    noise = NOISE * torch.randn(episodes, steps, generator=generator)
    other = torch.rand(episodes, steps, generator=generator)
    data = {
        "observation": torch.stack([level, other], -1).flatten(0, 1),
        "action": (level + noise).flatten()[:, None],
        "episode": torch.arange(episodes).repeat_interleave(steps),
    }
    return TensorDict(data, [episodes * steps])


def built(kind, **options):
    return kind(H, **({"hidden_dim": 32} | options), widths=[D_A, D_O, 1])


def learned(kind, data, iterations=400, **options):
    """As its ``fit`` does it, but faster; every tenth episode calibrates it."""
    torch.manual_seed(0)
    learner, generator = built(kind, **options), torch.Generator().manual_seed(0)
    held_out, buffers = data["episode"] % 10 == 9, []
    for part, size in ((data[~held_out], 256), (data[held_out], 4096)):
        buffers.append(
            window_replay_buffer(
                part, GaussianPrior(H), batch_size=size, observation_steps=1, generator=generator
            )
        )
    recipe = {"iterations": iterations, "generator": generator, "learning_rate": 1e-2}
    minimise(learner.learning_loss, learner, buffers[0], **recipe)
    if kind is not CVAEHistoryPrior:  # it draws, and has no scale to calibrate
        with torch.no_grad():
            learner.calibrate(buffers[1].sample())
    return learner.requires_grad_(False)


def learning_windows(chunk, counted, history, observation):
    parts = {"vla_action": {"chunk": chunk}, "action_is_pad": ~counted.squeeze(-1)}
    return TensorDict({**parts, "history": history, "observation": observation}, [len(chunk)])


@pytest.fixture(scope="module")
def data():
    return demonstrations()


@pytest.fixture(scope="module")
def batch():
    """Other episodes, at the middle of each half: the chunk and the history lie in it as well."""
    frames = torch.tensor([e * 40 + i for e in range(60) for i in (8, 28)])
    windows = window_transforms(demonstrations(seed=1), GaussianPrior(H), observation_steps=1)
    return windows(TensorDict({"frame": frames}, [len(frames)]))


def mean_of(learner, batch):
    if isinstance(learner, ForecastStart):
        return learner.centre(batch["history"], batch["observation"]) / learner.time
    return learner.distribution(batch["history"], batch["observation"]).loc


@pytest.mark.parametrize("kind", [LeapPrior, ForecastStart])
def test_a_forecast_learns_mean_and_spread(kind, data, batch):
    learner = learned(kind, data)
    mean = mean_of(learner, batch)
    level = batch["observation"][:, 0, :1, None].expand_as(mean)
    assert float((mean - level).square().mean().sqrt()) < 0.08
    if kind is not ForecastStart:
        source = learner.distribution(batch["history"], batch["observation"])
        assert float(source.scale.mean()) == pytest.approx(NOISE, rel=0.1)
        assert source.warm.all()  # where the network is, that is everywhere


def test_a2a_is_a_deterministic_forecast_of_the_last_actions(data, batch):
    prior = learned(A2APrior, data, iterations=800)
    source = prior.distribution(batch["history"]).sample()  # no observation
    assert torch.equal(source, prior.distribution(batch["history"]).loc)
    # Linear regression of the level (variance 1/12) on the mean of the last H actions.
    gain = (1 / 12) / (1 / 12 + NOISE**2 / H)
    best = gain * batch["history", "actions"].mean(-2, keepdim=True)
    assert float((source - best).square().mean().sqrt()) < 0.06


def test_the_calibration_makes_errors_as_large_as_they_are_said_to_be():
    """Per position and dimension, without what lies past the end of an episode, and never below a floor."""
    prior = ForecastPrior(H, hidden_dim=8, widths=[3, D_O, 1])
    g = torch.Generator().manual_seed(0)
    history, seen = random_history(prior, 500, action_dim=3), torch.rand(500, 1, D_O, generator=g)
    factor = torch.tensor([[0.2, 1.0, 5.0], [3.0, 0.5, 2.0]])
    source = prior.distribution(history, seen)
    mean, scale = source.loc, source.scale
    a1 = mean + factor * scale * torch.randn(500, H, 3, generator=g)
    counted = torch.rand(500, H, 1, generator=g) < 0.7
    a1 = a1.masked_fill(~counted, 100.0)
    prior.calibrate(learning_windows(a1, counted, history, seen))
    source = prior.distribution(history, seen)
    same, calibrated = source.loc, source.scale
    assert torch.equal(same, mean)
    torch.testing.assert_close(calibrated / scale, factor.expand_as(scale), rtol=0.1, atol=0)
    squared = ((a1 - mean) / calibrated).square().masked_fill(~counted, 0.0).sum(0)
    torch.testing.assert_close(squared / counted.sum(0), torch.ones(H, 3))
    typical = calibrated[counted.expand_as(calibrated)].square().mean().sqrt()
    torch.testing.assert_close(prior.typical_scale, typical)
    narrow = from_config(Prior, prior.config() | {"sigma": 0.5})
    narrow.load_state_dict(prior.state_dict())
    narrow.calibrate(learning_windows(mean, counted, history, seen))  # without any error: half the floor
    scale = narrow.distribution(history, seen).scale
    torch.testing.assert_close(scale, torch.full_like(scale, 0.01))


@pytest.mark.parametrize("kind", [ForecastPrior, ForecastStart, LeapPrior, A2APrior])
def test_only_what_a_source_sees_changes_it(kind, data, batch):
    changed = {LeapPrior: {"observation"}, A2APrior: {"actions"}}.get(kind, {"actions", "observation"})
    learner = learned(kind, data, iterations=5)
    before = mean_of(learner, batch)
    for name, key in (("actions", ("history", "actions")), ("observation", "observation")):
        other = batch.clone()
        other[key] += 1.0
        assert bool((mean_of(learner, other) != before).any()) == (name in changed)
    cold = batch.clone()
    cold["history", "steps"].fill_(H - 1)
    unknown = cold.clone()
    unknown["history", "actions"] += 7.0  # of which there are too few: it must not matter
    assert torch.equal(mean_of(learner, cold), mean_of(learner, unknown))


def test_a_cvae_that_sees_the_history_reads_it_once_it_is_full(data, batch):
    prior = learned(CVAEHistoryPrior, data, iterations=5)

    def chunks(windows):
        source = prior.distribution(windows["history"], windows["observation"])
        return source.sample(torch.Generator().manual_seed(0))

    before = chunks(batch)
    for key in (("history", "actions"), "observation"):
        other = batch.clone()
        other[key] += 1.0
        assert bool((chunks(other) != before).flatten(1).any(-1).all()), key
    cold = batch.clone()
    cold["history", "steps"].fill_(H - 1)
    unknown = cold.clone()
    unknown["history", "actions"] += 7.0
    assert torch.equal(chunks(cold), chunks(unknown))


def test_step_starts_on_the_path_to_the_forecast_and_a_robot_that_stays_meets_more_noise():
    start = built(ForecastStart, hidden_dim=8, start_time=0.75, stall=0.1, stall_noise=0.5)
    start.predicted = lambda history, observation: torch.full_like(history["forecast"], 0.4)
    history, noise = random_history(GaussianPrior(H), 3, action_dim=D_A, cold=0.0), torch.randn(3, H, D_A)
    history["actions"] = torch.tensor([0.4, 0.0, 0.4])[:, None, None].expand(3, H, D_A).clone()
    history["steps"][2] = H - 1  # too few to say that it stays
    factor = torch.tensor([1.5, 1.0, 1.0])[:, None, None]
    torch.testing.assert_close(start(noise, history, None), 0.25 * factor * noise + 0.75 * 0.4)
