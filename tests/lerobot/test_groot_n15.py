"""What is peculiar to GR00T N1.5; the rest is tested as for all families (``make test-groot-n15``)."""

import pytest
import torch

from tests.errors import refuses
from tests.lerobot.seen import at_times, watch
from tests.lerobot.tiny import ACTION, LENGTH, N15, STATE, STEPS, generator, observations
from warmprior import PastPrior, PreviewPrior
from warmprior.lerobot import WarmPriorAdapter

if not N15:
    pytest.skip("needs lerobot 0.5.1: make test-groot-n15", allow_module_level=True)


def integrated(seen):
    """The chunk by hand."""
    return (seen.x[0] + sum(seen.out) / STEPS)[..., :ACTION]


def test_the_first_actions_of_a_chunk_are_executed(built):
    every, half = 3, LENGTH // 2
    made = built("groot", n_action_steps=every).eval()
    batch = observations("groot", 2)
    with watch("groot", made) as seen:
        action = made.select_action(dict(batch))
    torch.testing.assert_close(action, integrated(seen)[:, -every])  # LeRobot: the last ones
    made.reset()
    adapter = WarmPriorAdapter(made, PreviewPrior(half, sigma=0.0), generator=generator())
    chunks = []
    for _ in range(2):
        with watch("groot", made) as seen:
            actions = torch.stack([adapter.select_action(dict(batch)) for _ in range(every)], 1)
        assert len(seen.x) == STEPS  # one decision
        chunks.append(integrated(seen))
        torch.testing.assert_close(actions, chunks[-1][:, :every])
    torch.testing.assert_close(seen.x[0][:, :half, :ACTION], chunks[0][:, every : every + half])
    assert adapter.predict_action_chunk(dict(batch)).shape == (2, LENGTH, ACTION)


@pytest.fixture
def preprocessed(policy):
    """Raw actions, their statistics and LeRobot's own preprocessor."""
    from lerobot.policies.groot.processor_groot import make_groot_pre_post_processors

    actions = torch.randn(200, 2 * LENGTH, ACTION, generator=generator())
    actions = actions * torch.linspace(0.1, 3.0, ACTION) + 5.0
    flat = actions.flatten(0, 1)
    stats = {"action": {"min": flat.amin(0), "max": flat.amax(0), "std": flat.std(0)}}
    pipeline, _ = make_groot_pre_post_processors(policy("groot").config, stats)

    def preprocess(raw):
        # No images: what encodes them is on the hub.
        return pipeline({"action": raw, "observation.state": torch.zeros(len(raw), STATE)})

    return actions, stats, preprocess


def test_history_through_the_preprocessor(policy, preprocessed):
    actions, stats, preprocess = preprocessed
    made = policy("groot").train()
    raw = actions[:3]
    own = stats["action"]
    by_hand = 2 * (raw - own["min"]) / (own["max"] - own["min"]) - 1
    is_pad = torch.zeros(3, 2 * LENGTH, dtype=torch.bool)
    batch = {
        **observations("groot", 3),
        **preprocess(raw[:, LENGTH:]),
        "action_is_pad": is_pad[:, LENGTH:],
        "action_history": preprocess(raw[:, :LENGTH])["action"],
        "action_history_is_pad": is_pad[:, :LENGTH],
    }
    adapter = WarmPriorAdapter(made, PastPrior(LENGTH, sigma=0.0), generator=generator())
    for t, expected in ((0.0, by_hand[:, :LENGTH]), (1.0, by_hand[:, LENGTH:])):
        with watch("groot", made) as seen, at_times("groot", made, torch.full((3,), t)):
            adapter.loss(batch)
        torch.testing.assert_close(seen.x[0][..., :ACTION], expected)
    # It keeps the first actions of a longer window, which are the history.
    cut = {**observations("groot", 3), **preprocess(raw), "action_is_pad": is_pad}
    refuses(lambda: adapter.loss(cut), ValueError, "{'action': 8}", "{'action': 16")
