"""The plugin's policies where LeRobot's real-time chunking replans before a chunk is used up."""

import pytest
import torch

from tests.errors import raises
from tests.lerobot.plugin_policies import VLA, warm
from tests.lerobot.tiny import ACTION, LENGTH, observations


def rollout(policy, family, plan, horizon):
    """LeRobot's engine and robot: per decision its delay, and how much is executed behind it.

    Returns what was executed before every decision, with the history that its source was made from.
    """
    from lerobot.policies.rtc import ActionQueue, RTCConfig
    from lerobot.rollout.inference.rtc import _normalize_prev_actions_length, supports_rtc_inference

    policy.config.rtc_config = RTCConfig(execution_horizon=horizon)
    if hasattr(policy, "init_rtc_processor"):
        policy.init_rtc_processor()
    assert supports_rtc_inference(policy)
    queue, done, decisions = ActionQueue(policy.config.rtc_config), [], []
    source = policy.warm_adapter.source
    draw = type(source).distribution
    source.distribution = lambda history: decisions.append((len(done), history)) or draw(source, history)

    def execute(steps):
        for _ in range(steps):
            if (action := queue.get()) is not None:
                done.append(action)

    for delay, steps in plan:
        before, rest = queue.get_action_index(), queue.get_left_over()
        if rest is not None:
            rest = _normalize_prev_actions_length(rest, horizon)
        chunk = policy.predict_action_chunk(
            observations(family, 1), inference_delay=delay, prev_chunk_left_over=rest
        )
        execute(delay)
        original = chunk.squeeze(0).clone()
        queue.merge(original, original, delay, before)
        execute(steps)
    return torch.stack(done), decisions


@pytest.mark.parametrize("name", VLA)
@pytest.mark.parametrize("prior", ["past", "preview"])
def test_what_was_executed_is_counted_by_what_is_left(found, name, prior):
    torch.manual_seed(0)
    family = name.removeprefix("warm_")
    policy = warm(found, name, prior=prior, n_action_steps=LENGTH if prior == "past" else LENGTH // 2).eval()
    policy.reset()
    plan = [(0, 3), (1, 2), (2, 1), (0, 4), (1, 7), (0, 2), (0, 1)]
    if name == "warm_groot":  # no more than n_action_steps
        plan = [(0, 3), (1, 2), (1, 1), (0, 2), (1, 3), (0, 2), (0, 1)]
    for horizon in (2, 5):
        policy.reset()
        done, decisions = rollout(policy, family, plan, horizon)
        assert len(decisions) == len(plan)
        for count, history in decisions:
            steps, remembered = int(history["steps"]), history["actions"].shape[1]
            assert steps == min(count, remembered)
            executed = done[max(0, count - remembered) : count]
            assert torch.equal(history["actions"][0, remembered - steps :], executed)


def test_what_is_left_over_must_be_of_the_last_chunk(found):
    from lerobot.policies.rtc import RTCConfig

    policy = warm(found, "warm_pi05", prior="past", n_action_steps=LENGTH).eval()
    policy.reset()
    batch = observations("pi05", 2)
    chunk = policy.predict_action_chunk(dict(batch), inference_delay=0, prev_chunk_left_over=None)
    with raises(ValueError, "prev_chunk_left_over", "executed_steps="):
        policy.predict_action_chunk(dict(batch), inference_delay=1, prev_chunk_left_over=chunk[:, 2:5] + 1)
    with raises(ValueError, "executed_steps=", "prev_chunk_left_over"):
        policy.predict_action_chunk(dict(batch))
    policy.predict_action_chunk(dict(batch), inference_delay=1, prev_chunk_left_over=chunk[:, LENGTH:])
    with raises(TypeError, "executed_step,"):
        policy.predict_action_chunk(dict(batch), executed_steps=1, **{"executed_step,": 2})
    policy.config.rtc_config = RTCConfig(enabled=False)
    with raises(ValueError, "rtc.enabled=false"):
        policy.predict_action_chunk(dict(batch), inference_delay=1, prev_chunk_left_over=chunk[:, 2:5])


def test_more_executed_than_the_prior_remembers(policy):
    """As on a robot whose next chunk is late; the chunk has no more actions than the prior predicts."""
    from warmprior import PastPrior, PreviewPrior
    from warmprior.lerobot import WarmPriorAdapter

    batch = observations("pi05", 1)
    for prior in (PreviewPrior(3, sigma=0.0), PastPrior(5, sigma=0.0)):
        made = policy("pi05", n_action_steps=3)
        adapter = WarmPriorAdapter(made, prior)
        chunk = adapter.predict_action_chunk(dict(batch))
        assert chunk.shape == (1, prior.prediction_length, ACTION)
        rest = chunk[:, 5:]
        adapter.predict_action_chunk(dict(batch), inference_delay=4, prev_chunk_left_over=rest)
        history = adapter._memory._history
        assert torch.equal(history["actions"], chunk[:, 5 - prior.history_length : 5])
        assert int(history["forecast_steps"]) == prior.prediction_length - 5
