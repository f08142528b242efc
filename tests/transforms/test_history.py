"""ActionHistory against lists of executed actions, and a user's own prior from window to environment."""

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import raises, refuses
from tests.toy_env import (
    ACTION_DIM,
    PLACES,
    ChunkPolicy,
    CountingEnv,
    Momentum,
    closing,
    mlp_actor,
    placed,
    random_history,
    window_histories,
)
from warmprior import (
    ActionHistory,
    ChunkStep,
    GaussianPrior,
    HistoryObservation,
    PastPrior,
    PreviewPrior,
    keys,
    policy_transforms,
)
from warmprior.history import ENTRIES

LEAVES = {(keys.HISTORY, name) for name in ENTRIES}


def transforms(horizon, length=None, *, execute=None, remembered=None):
    chunk = ChunkStep(horizon, execute=execute, prediction_length=length)
    return Compose(chunk, ActionHistory(horizon if remembered is None else remembered))


def random_policy(length, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def chunk(data):
        return torch.rand((*data.batch_size, length, ACTION_DIM), generator=generator) * 2 - 1

    return ChunkPolicy(chunk)


@settings(max_examples=20, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=3),
    horizon=st.integers(1, 5),
    further=st.integers(0, 5),
    longer=st.integers(0, 3),
    data=st.data(),
)
def test_history_is_the_list_of_executed_actions(lengths, horizon, further, longer, data):
    execute = data.draw(st.integers(1, horizon))
    length, remembered = horizon + further, horizon + longer
    base = SerialEnv(len(lengths), [partial(CountingEnv, n) for n in lengths])
    env = TransformedEnv(base, transforms(horizon, length, execute=execute, remembered=remembered))
    rollout = env.rollout(10, random_policy(length), break_when_any_done=False)
    env.close()
    zero = [torch.zeros(ACTION_DIM)]
    for row, end in zip(rollout, lengths, strict=True):
        executed, left = [], []
        for step in row:
            history, real = step["history"], executed[-remembered:]
            assert step["observation"][0] == len(executed)
            assert history["steps"].item() == len(real)
            padded = zero * (remembered - len(real)) + real
            assert torch.equal(history["actions"], torch.stack(padded))
            assert history["forecast_steps"].item() == len(left)
            padded = left + zero * (length - len(left))
            assert torch.equal(history["forecast"], torch.stack(padded))
            chunk = step["vla_action", "chunk"]
            k = min(execute, end - len(executed))
            executed, left = executed + list(chunk[:k]), list(chunk[k:])
            if len(executed) == end:
                executed, left = [], []


def test_parts_that_do_not_go_together():
    for behind in ([], [ChunkStep(3)]):
        with raises(KeyError, "ChunkStep"):
            TransformedEnv(CountingEnv(5), Compose(ActionHistory(3), *behind)).reset()
    refuses(lambda: ActionHistory(0), ValueError, "history_length", 0)
    # More executed than remembered.
    env = TransformedEnv(CountingEnv(9), Compose(ChunkStep(3), ActionHistory(2)))
    refuses(lambda: env.rollout(2), ValueError, 3, 2)
    # An environment made for another prior, and a policy that meets it.
    env = TransformedEnv(CountingEnv(9), policy_transforms(PastPrior(3)))
    refuses(lambda: env.rollout(2, mlp_actor(PreviewPrior(3), nfe=1)), ValueError, "PreviewPrior", 6, 3)
    with raises(KeyError, "ActionHistory", "'history'"):
        env.step(env.rand_action(env.reset()).exclude("history"))


def test_the_last_actions_are_part_of_the_observation():
    """Flattened, once there are ``H``, and whether there are; the same in windows and environments."""
    prior = GaussianPrior(3)
    transforms = policy_transforms(prior, observation_steps=2, see_history=True, execute=2)
    env = TransformedEnv(CountingEnv(9), transforms)
    check_env_specs(env)
    rollout = env.rollout(5, random_policy(3))
    seen, own, history = rollout[keys.CONDITIONED], rollout["observation"], rollout["history"]
    assert seen.shape == (5, 2, 4 + HistoryObservation.width(3, ACTION_DIM))
    assert history["steps"].flatten().tolist() == [0, 2, 3, 3, 3]
    for decision, known in enumerate([0.0, 0.0, 1.0, 1.0, 1.0]):
        added = torch.cat([known * history["actions"][decision].flatten(), torch.tensor([known])])
        for i in range(2):
            assert torch.equal(seen[decision, i], torch.cat([own[decision, i], added]))
    data = TensorDict({"observation": own, "history": history}, [5])
    assert torch.equal(HistoryObservation()(data)[keys.CONDITIONED], seen)
    whole = data.set("observation", own.long())  # whole numbers do not cut the actions
    assert torch.equal(HistoryObservation()(whole)[keys.CONDITIONED][..., 4:], seen[..., 4:])


def test_keys_that_it_lacks_are_named():
    data = TensorDict({"observation": torch.zeros(1, 2, 4)}, [1])
    lacking = f"missing: {[keys.ACTIONS, keys.STEPS]}"
    refuses(lambda: HistoryObservation()(data), KeyError, lacking)
    env = TransformedEnv(CountingEnv(5), HistoryObservation())
    refuses(lambda: env.observation_spec, KeyError, lacking, "ActionHistory")
    data["history"] = random_history(GaussianPrior(3), 1)
    with raises(KeyError, "missing: [('prior', 'observation')]"):
        mlp_actor(GaussianPrior(3), observation_dim=11, observation_key=keys.CONDITIONED)(data)


@pytest.mark.parametrize("place", PLACES[1:])
def test_every_decision_meets_the_mean_of_its_training_window(place):
    """To the bit, with one action per decision, rows that rest and rows that begin anew whenever."""
    prior, policy = Momentum(4, sigma=0.0), random_policy(4)
    g = torch.Generator().manual_seed(0)
    episodes, decisions = [[[]], [[]], [[]]], []
    with closing(placed(place, lambda: policy_transforms(prior, execute=1), (5, 9, 23))) as env:
        data = env.reset()
        for _ in range(40):
            data = policy(data)
            step = torch.rand(3, generator=g) < 0.7
            step = step if step.any() else ~step
            data["_step"] = step
            for row in step.nonzero().flatten().tolist():
                executed = episodes[row][-1]
                found = prior.distribution(data["history"][row])
                decisions.append((row, len(episodes[row]) - 1, len(executed), found))
                executed.append(data["vla_action", "chunk"][row, 0].clone())
            data = env.step(data)
            done = data["next", "done"].flatten() & step
            data = env.step_mdp(data).exclude("_step")
            reset = done | (torch.rand(3, generator=g) < 0.1)
            if reset.any():
                data = env.reset(data.set("_reset", reset.unsqueeze(-1)))
                for row in reset.nonzero().flatten().tolist():
                    episodes[row].append([])
    for row, episode, frame, source in decisions:
        actions = torch.stack(episodes[row][episode])
        expected = prior.distribution(window_histories(actions, torch.tensor(frame), 4))
        assert torch.equal(source.loc, expected.loc) and torch.equal(source.scale, expected.scale)
        warm = source.warm
        assert torch.equal(warm, expected.warm) and warm.all() == warm.any() == (frame >= 2)
    assert len(decisions) > 70 and sum(bool(source.warm.all()) for *_, source in decisions) > 40
