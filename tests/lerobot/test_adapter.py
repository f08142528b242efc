import pytest
import torch

from tests.errors import raises, refuses
from tests.lerobot.seen import at_times, watch
from tests.lerobot.tiny import ACTION, LENGTH, generator, observations, windows
from tests.toy_env import Momentum, window_histories
from warmprior import PastPrior, PreviewPrior, RealTimeChunking
from warmprior.history import cold_history, window_history
from warmprior.lerobot import RelativeActions, WarmPriorAdapter, action_std


def started(adapter, family, policy, batch, steps):
    """Actions given ``[B, steps, d_a]``, and the source of each decision."""
    sources, actions = [], []
    for _ in range(steps):
        with watch(family, policy) as seen:
            actions.append(adapter.select_action(dict(batch)))
        if seen.x:
            sources.append(seen.x[0][..., :ACTION])
    return torch.stack(actions, 1), sources


@pytest.mark.parametrize("family", ["pi05", "smolvla"])
def test_chunks_are_guided_towards_the_rest_of_the_last_one(built, monkeypatch, family):
    """On a linear field, whose Jacobian is known, with LeRobot's own weights of positions."""
    from lerobot.configs import RTCAttentionSchedule
    from lerobot.policies.rtc import RTCConfig
    from lerobot.policies.rtc.modeling_rtc import RTCProcessor

    made, executed, delay, nfe, sigma, slope = built(family), 3, 2, 4, 0.3, 0.8
    monkeypatch.setattr(made.model, "denoise_step", lambda *args, x_t, timestep, **kw: slope * (x_t - 0.2))
    rtc = RealTimeChunking(schedule="linear")
    prior = PastPrior(LENGTH, sigma=sigma)
    adapter = WarmPriorAdapter(made, prior, nfe=nfe, guidance=rtc, generator=generator())
    sources, draw = [], adapter.source.place
    monkeypatch.setattr(adapter.source, "place", lambda *args: sources.append(draw(*args)) or sources[-1])
    batch = observations(family, 2)
    chunks = [adapter.predict_action_chunk(dict(batch))]  # nothing to be guided by, nor to wait for
    for decision in range(3):
        now = delay if decision else 0
        chunks.append(adapter.predict_action_chunk(dict(batch), executed_steps=executed, delay=now))
        rest = torch.zeros_like(sources[-1])
        left = LENGTH - executed
        rest[:, :left, :ACTION] = chunks[-2][:, executed:]
        processor = RTCProcessor(RTCConfig(prefix_attention_schedule=RTCAttentionSchedule.LINEAR))
        weights = processor.get_prefix_weights(now, left, LENGTH)[:, None]
        width = torch.ones_like(rest)
        if executed * (decision + 1) >= LENGTH:  # warm
            width[..., :ACTION] = sigma
        a = sources[-1]
        for step in range(nfe):
            t = step / nfe
            v = -slope * (a - 0.2)
            g = width**2 * (1 - t) / max(t, 1e-30) + t / (1 - t)
            g = g.clamp(max=rtc.max_guidance_weight)
            a = a + (v + g * (1 - (1 - t) * slope) * weights * (rest - (a + (1 - t) * v))) / nfe
        expected = a[..., :ACTION]
        expected[:, :now] = chunks[-2][:, executed : executed + now]
        torch.testing.assert_close(chunks[-1], expected)
    with raises(ValueError, "delay", 4):
        adapter.predict_action_chunk(dict(batch), executed_steps=LENGTH - 1, delay=4)
    with raises(ValueError, "delay", 1):
        adapter.predict_action_chunk(dict(batch), executed_steps=torch.tensor([LENGTH, 2]), delay=1)
    with raises(ValueError, "delay", 0.5):
        adapter.predict_action_chunk(dict(batch), executed_steps=1, delay=0.5)
    refuses(lambda: adapter.select_action(dict(batch)), ValueError, "n_action_steps", LENGTH)
    with raises(ValueError, "pi0, pi05", "smolvla"):
        WarmPriorAdapter(built("multi_task_dit"), PastPrior(4), guidance=rtc)


def test_an_environment_that_is_reset_starts_cold(policy):
    made = policy("pi05")
    adapter = WarmPriorAdapter(made, PastPrior(LENGTH, sigma=0.0), generator=generator())
    batch = observations("pi05", 3)
    actions, _ = started(adapter, "pi05", made, batch, LENGTH)
    adapter.reset(torch.tensor([True, False, False]))
    more, (source,) = started(adapter, "pi05", made, batch, LENGTH)
    assert torch.equal(source[1:], actions[1:]) and not torch.equal(source[0], actions[0])
    assert abs(source[0].std() - 1) < 0.5
    _, (source,) = started(adapter, "pi05", made, batch, LENGTH)
    assert torch.equal(source, more)  # warm again, with what it did since
    adapter.reset()
    _, (source,) = started(adapter, "pi05", made, batch, LENGTH)
    assert abs(source.std() - 1) < 0.3


def test_the_history_before_an_episode_does_not_leak(policy):
    """LeRobot fills it with the first action, which is the target."""
    made = policy("pi05").train()
    batch = windows("pi05", 3, LENGTH)
    batch["action_is_pad"][0, :5] = True
    losses = []
    for filler, added in ((0.0, 0.0), (100.0, 0.0), (100.0, 1.0)):
        batch["action"][0, :5] = filler
        batch["action"][1, :5] += added  # a history that counts
        torch.manual_seed(1)
        adapter = WarmPriorAdapter(made, PastPrior(LENGTH), generator=generator())
        losses.append(adapter.loss(batch, reduction="none")[0])
    assert torch.equal(losses[0], losses[1])
    assert (losses[2] != losses[0]).tolist() == [False, True, False]


def test_a_users_prior_has_the_mean_of_its_training_windows(built):
    """At every decision of an episode, whatever of it was executed."""
    every, steps, prior = 3, 16, Momentum(4, sigma=0.0)
    made = built("pi0", n_action_steps=every)
    adapter = WarmPriorAdapter(made, prior, generator=generator())
    actions, sources = started(adapter, "pi0", made, observations("pi0", 1), steps)
    decisions = torch.arange(0, steps, every)
    source = prior.distribution(window_histories(actions[0], decisions, prior.chunk_length))
    assert source.warm[:, 0, 0].tolist() == [False, *[True] * (len(decisions) - 1)]
    # Without noise the source is the mean.
    assert torch.equal(torch.cat(sources)[1:, :4], source.loc[1:])
    made.train()
    assert adapter.loss(windows("pi0", 2, 4))[0].isfinite()


def test_withheld_histories_start_cold(policy):
    made = policy("pi05").train()
    batch, t = windows("pi05", 64, LENGTH), torch.ones(64)  # at the source
    for probability, cold in ((0.0, 0), (1.0, 64), (0.5, None)):
        options = {"cold_probability": probability, "generator": generator()}
        adapter = WarmPriorAdapter(made, PastPrior(LENGTH, sigma=0.0), **options)
        with watch("pi05", made) as seen, at_times("pi05", made, t):
            adapter.loss(dict(batch))
        other = (seen.x[0][..., :ACTION] != batch["action"][:, :LENGTH]).flatten(1)
        assert torch.equal(other.any(1), other.all(1))  # whole windows
        found = int(other.any(1).sum())
        assert found == cold if cold is not None else 16 < found < 48
    with raises(ValueError, "cold_probability", 1.5):
        WarmPriorAdapter(made, PastPrior(LENGTH), cold_probability=1.5)


@pytest.mark.parametrize("prior", [PastPrior(LENGTH, sigma=0.5), PreviewPrior(LENGTH // 2, sigma=0.5)])
def test_sigma_in_units_of_the_data(policy, prior):
    made = policy("xvla", n_action_steps=prior.chunk_length)  # raw units
    std = torch.linspace(0.1, 3.0, ACTION)
    adapter = WarmPriorAdapter(made, prior, std=std, generator=generator())
    loc, length = torch.full((500, LENGTH, ACTION), 2.0), prior.chunk_length
    warm = window_history(loc[:, :length], torch.full((500, 1), length), loc, length)
    cold = cold_history([500], length, LENGTH, ACTION)
    drawn = adapter.source.draw(warm, generator(1))[:, :length]
    torch.testing.assert_close(drawn.mean((0, 1)), torch.full((ACTION,), 2.0), rtol=0, atol=0.2)
    torch.testing.assert_close(drawn.flatten(0, 1).std(0), 0.5 * std, rtol=0.1, atol=0)
    cold = adapter.source.draw(cold, generator(1))
    torch.testing.assert_close(cold.flatten(0, 1).std(0), torch.ones(ACTION), rtol=0.1, atol=0)


def test_the_standard_deviation_in_a_policys_units(policy):
    values = torch.randn(1000, ACTION, generator=generator()) * torch.linspace(0.1, 3.0, ACTION)
    quantile = {f"q{p:02d}": values.quantile(p / 100, dim=0) for p in (1, 10, 90, 99)}
    stats = {"action": {"std": values.std(0), "min": values.amin(0), "max": values.amax(0), **quantile}}
    by_hand = {
        "smolvla": values / values.std(0),
        "pi05": 2 * (values - quantile["q01"]) / (quantile["q99"] - quantile["q01"]) - 1,
        "multi_task_dit": 2 * (values - values.amin(0)) / (values.amax(0) - values.amin(0)) - 1,
    }
    for family, normalised in by_hand.items():
        torch.testing.assert_close(action_std(policy(family), stats), normalised.std(0))
    refuses(lambda: action_std(policy("pi05"), None), ValueError, "std, q01, q99", "'action'")
    refuses(lambda: action_std(policy("xvla"), stats), ValueError, "IDENTITY")
    with raises(ValueError, "std", "got 0.0"):
        WarmPriorAdapter(policy("pi05"), PastPrior(LENGTH), std=values.std(0) * 0)


def pipelines(made, stats):
    """The steps of pi0's own, which need the hub's tokenizer besides."""
    from lerobot.processor import (
        NormalizerProcessorStep,
        PolicyProcessorPipeline,
        RelativeActionsProcessorStep,
        UnnormalizerProcessorStep,
    )

    config = made.config
    parts = {"norm_map": config.normalization_mapping, "stats": stats}
    features = {**config.input_features, **config.output_features}
    before = [RelativeActionsProcessorStep(enabled=True), NormalizerProcessorStep(features=features, **parts)]
    after = [UnnormalizerProcessorStep(features=config.output_features, **parts)]
    return PolicyProcessorPipeline(steps=before), PolicyProcessorPipeline(steps=after)


def test_relative_actions_follow_the_state(built):
    made = built("pi0", use_relative_actions=True)
    stats = {
        "action": {"mean": torch.arange(7.0), "std": torch.linspace(0.5, 2.0, 7)},
        "observation.state": {"mean": torch.zeros(7), "std": torch.ones(7)},
    }
    preprocess, postprocess = pipelines(made, stats)
    relative = RelativeActions(preprocess, postprocess)
    adapter = WarmPriorAdapter(made, PastPrior(LENGTH, sigma=0.0), relative=relative, generator=generator())
    refuses(lambda: WarmPriorAdapter(made, PastPrior(LENGTH)), ValueError, "relative=RelativeActions")
    batch = observations("pi0", 2)
    states = torch.randn(2, 2, 7, generator=generator(5))

    def observed(state):
        # As a rollout does: the pipeline sees the raw state before the policy decides.
        seen = preprocess({"observation.state": state, "task": ["", ""]})
        return {**batch, "observation.state": seen["observation.state"]}

    first = adapter.predict_action_chunk(observed(states[0]))
    with watch("pi0", made) as seen:
        adapter.predict_action_chunk(observed(states[1]), executed_steps=LENGTH)
    mean, std = stats["action"]["mean"], stats["action"]["std"]
    absolute = first * std + mean + states[0][:, None]
    expected = (absolute - states[1][:, None] - mean) / std
    torch.testing.assert_close(seen.x[0][..., :ACTION], expected, rtol=1e-4, atol=1e-5)


def test_batches_that_do_not_fit(policy):
    adapter = WarmPriorAdapter(policy("pi05"), PastPrior(LENGTH))
    batch = windows("pi05", 2, LENGTH)
    with raises(KeyError, "action_is_pad"):
        adapter.loss({key: value for key, value in batch.items() if key != "action_is_pad"})
    short = {name: batch[name][:, LENGTH:] for name in ("action", "action_is_pad")}
    refuses(lambda: adapter.loss({**batch, **short}), ValueError, "{'action': 8}", "{'action': 16}")
    adapter.predict_action_chunk(observations("pi05", 2))
    refuses(lambda: adapter.predict_action_chunk(observations("pi05", 2)), ValueError, "executed_steps=")
    with raises(ValueError, "noise="):
        noise = torch.zeros(2, LENGTH, 12)
        adapter.predict_action_chunk(observations("pi05", 2), executed_steps=1, noise=noise)
