"""Smoothness of rollouts against plain loops over the executed actions."""

import math
import pickle
import random
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import SerialEnv, TransformedEnv

from tests.errors import raises, refuses
from tests.toy_env import ACTION_DIM, CountingEnv, mlp_actor, stirred
from warmprior import ChunkStep, GaussianPrior, HistoryObservation, PastPrior, keys
from warmprior.diagnostics import executed_actions, smoothness
from warmprior.diagnostics.leaks import HistoryShift
from warmprior.history import cold_history


def rollout_of(chunks, steps, done=None):
    steps = torch.as_tensor(steps).unsqueeze(-1)
    data = {"vla_action": {"chunk": chunks}, "next": {"executed_steps": steps}}
    if done is not None:
        data["next"]["done"] = torch.as_tensor(done).unsqueeze(-1)
    return TensorDict(data, steps.shape[:-1])


@settings(max_examples=50, deadline=None)
@given(
    rows=st.integers(1, 3), decisions=st.integers(2, 6), horizon=st.integers(1, 4), seed=st.integers(0, 10**6)
)
def test_against_loops(rows, decisions, horizon, seed):
    rng = random.Random(seed)
    generator = torch.Generator().manual_seed(seed)
    chunks = torch.randn(rows, decisions, horizon + 1, 2, generator=generator)
    steps = [[rng.randint(0, horizon) for _ in range(decisions)] for _ in range(rows)]
    steps[0][:2] = [horizon, 1]
    done = [[rng.random() < 0.3 for _ in range(decisions)] for _ in range(rows)]
    done[0][0] = False
    boundary, inner, jerk = [], [], []
    for b in range(rows):
        episodes = [[]]
        for j in range(decisions):
            episodes[-1] += [(j, chunks[b, j, i].tolist()) for i in range(steps[b][j])]
            if done[b][j]:
                episodes.append([])
        for episode in episodes:
            for (j, x), (k, y) in pairwise(episode):
                (boundary if j != k else inner).append(math.dist(x, y))
            actions = [action for _, action in episode]
            for p, q, r, s in zip(actions, actions[1:], actions[2:], actions[3:], strict=False):
                third = [d - 3 * c + 3 * b - a for a, b, c, d in zip(p, q, r, s, strict=True)]
                jerk.append(math.hypot(*third))
    result = smoothness(rollout_of(chunks, steps, done))

    def mean(values):
        return sum(values) / len(values) if values else math.nan

    assert result.boundaries == len(boundary)
    assert result.boundary_jump == pytest.approx(mean(boundary), rel=1e-4)
    assert result.inner_jump == pytest.approx(mean(inner), rel=1e-4, nan_ok=True)
    assert result.jerk == pytest.approx(mean(jerk), rel=1e-3, nan_ok=True)


def test_jumps_between_chunks_that_hold_still_are_infinitely_larger():
    chunks = torch.arange(3.0).view(3, 1, 1).expand(3, 2, 1)
    assert smoothness(rollout_of(chunks, [2, 2, 2])).jump_ratio == math.inf
    assert math.isnan(smoothness(rollout_of(chunks, [1, 1, 1])).jump_ratio)  # nothing inside a chunk


@pytest.mark.parametrize("decisions", [1, 2, 5])
def test_rows_of_a_collector_may_be_joined(decisions):
    """As `data.reshape(-1)` does, whose rows begin without an end before them."""
    chunks = torch.randn(3, decisions, 2, 2, generator=torch.Generator().manual_seed(0))
    rollout = rollout_of(chunks, [[2] * decisions] * 3)
    rollout["collector", "traj_ids"] = torch.arange(3)[:, None].expand(3, decisions).clone()
    if decisions == 1:
        refuses(lambda: smoothness(rollout.reshape(-1)), ValueError, "chunk boundary")
        return
    one, other = smoothness(rollout), smoothness(rollout.reshape(-1))
    assert vars(one) == pytest.approx(vars(other), nan_ok=True)


def test_decisions_that_a_rollout_repeats_in_ended_rows_count_once():
    env = TransformedEnv(SerialEnv(2, [lambda: CountingEnv(7), lambda: CountingEnv(20)]), ChunkStep(4))
    rollout = env.rollout(9, break_when_any_done=False, break_when_all_done=True)
    assert rollout["next", "done"][0].sum() > 1  # the short row's last decision is repeated
    executed, decision, _ = executed_actions(rollout)
    short, long = rollout["vla_action", "chunk"].unbind(0)
    expected = torch.full((20, ACTION_DIM), math.nan)
    expected[:7] = torch.cat([short[0], short[1, :3]])
    torch.testing.assert_close(executed, torch.stack([expected, long.flatten(0, 1)]), equal_nan=True)
    assert (decision[0, 7:] == -1).all()


def test_equal_chunks_of_short_episodes_all_count():
    """Episodes of one decision each, of a policy that always says the same."""

    def policy(td):
        return td.set(keys.CHUNK, torch.ones(4, ACTION_DIM))

    env = TransformedEnv(CountingEnv(3), ChunkStep(4))
    _, decision, episode = executed_actions(env.rollout(5, policy, break_when_any_done=False))
    assert decision.tolist() == episode.tolist() == [i for i in range(5) for _ in range(3)]
    joined = rollout_of(torch.ones(4, 3, 1), [3] * 4, [True] * 4)
    joined["collector", "traj_ids"] = torch.arange(4)
    assert len(executed_actions(joined)[0]) == 12


def test_bad_rollouts_are_named():
    chunks = torch.zeros(3, 2, 1)
    refuses(lambda: smoothness(TensorDict({"vla_action": {"chunk": chunks}}, [3])), KeyError, "ChunkStep")
    for rollout in (rollout_of(chunks[:1], [2]), rollout_of(chunks[:2], [2, 2], [True, True])):
        with raises(ValueError, "chunk boundary"):
            smoothness(rollout)
    refuses(lambda: smoothness(rollout_of(chunks * math.nan, [2, 2, 2])), ValueError, "NaN")
    with raises(ValueError, "decisions"):
        executed_actions(rollout_of(chunks[:0], torch.zeros(0, dtype=torch.int64)))


@pytest.mark.parametrize("see_history", [False, True])
def test_history_shift_disturbs_what_the_policy_sees_and_nothing_else(see_history, monkeypatch):
    prior = GaussianPrior(2) if see_history else PastPrior(2)
    width = HistoryObservation.width(2, 1) if see_history else 0
    key = keys.CONDITIONED if see_history else keys.OBSERVATION
    options = {"observation_key": key, "generator": torch.Generator().manual_seed(0)}
    actor = stirred(mlp_actor(prior, 1, 3 + width, steps=1, **options), by=1.0)
    data = TensorDict({"observation": torch.zeros(4, 1, 3), "history": cold_history([4], 2, 2, 1)}, [4])
    data["history", "actions"][:2] = 1.0
    data["history", "steps"][:2] = 2
    expected = data.clone()
    noise = torch.randn(4, 2, 1, generator=torch.Generator().manual_seed(5))
    expected["history", "actions"][:2] += 0.3 * noise[:2]
    chunk = actor(HistoryObservation()(expected))["vla_action", "chunk"]
    actor.sampler.generator.manual_seed(0)
    disturbed = HistoryShift(actor, 0.3, generator=torch.Generator().manual_seed(5))
    out = disturbed(HistoryObservation()(data))
    torch.testing.assert_close(out["vla_action", "chunk"], chunk)
    assert (out["history", "actions"][:2] == 1).all()
    for generator, seed in ((actor.sampler.generator, 0), (disturbed.generator, 5)):
        generator.manual_seed(seed)
    *_, dispatched = disturbed(*(data[key] for key in disturbed.in_keys))
    torch.testing.assert_close(dispatched, chunk)
    refuses(lambda: HistoryShift(actor, -1.0), ValueError, "std")
    monkeypatch.setattr("warmprior.modules.generator.get_spawning_popen", lambda: object())
    with raises(RuntimeError, "same noise"):
        disturbed.policy = actor.replace(generator=None)
        pickle.loads(pickle.dumps(disturbed))(data)
