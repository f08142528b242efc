"""ActionHistory against lists of executed actions, and a user's own prior from window to environment."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torchrl.envs import Compose, GymEnv, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.toy_env import ACTION_DIM, ChunkPolicy, CountingEnv, random_history
from warmprior import (
    ActionHistory,
    ActionWindow,
    ChunkStep,
    FlowMatchingLoss,
    GaussianPrior,
    HistoryObservation,
    PastPrior,
    PreviewPrior,
    Prior,
    VelocityMLP,
    WarmPriorActor,
    keys,
    policy_transforms,
    window_replay_buffer,
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
        executed: list[torch.Tensor] = []
        left: list[torch.Tensor] = []
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


@pytest.mark.parametrize(("horizon", "length"), [(1, 1), (4, 8)])
def test_specs_and_cold_reset(horizon, length):
    env = TransformedEnv(SerialEnv(2, partial(CountingEnv, 9)), transforms(horizon, length))
    check_env_specs(env)
    data = env.reset()
    assert set(data.keys(True, True)) >= LEAVES
    assert data[keys.ACTIONS].shape == (2, horizon, ACTION_DIM)
    assert data[keys.FORECAST].shape == (2, length, ACTION_DIM)
    assert not any(data[key].any() for key in LEAVES)


def test_one_environment_may_reset_alone():
    base = SerialEnv(2, [partial(CountingEnv, n) for n in (2, 9)])
    env = TransformedEnv(base, transforms(2, 4))
    data = env.step(random_policy(4)(env.reset()))
    kept = data["next", "history"][1].clone()
    data = env.step_mdp(data)
    data = env.reset(data.set("_reset", torch.tensor([[True], [False]])))
    assert not any(data[key][0].any() for key in LEAVES)
    assert (data["history"][1] == kept).all() and kept["steps"] == kept["forecast_steps"] == 2


@pytest.mark.parametrize("execute", [2, 3])
def test_rows_that_rest_keep_their_history(execute):
    """Outside of workers a partial step comes with chunks for all rows; those that rest execute none."""
    env = TransformedEnv(SerialEnv(2, partial(CountingEnv, 30)), transforms(3, 6, execute=execute))
    policy = random_policy(6)
    data = env.reset()
    for _ in range(2):
        data = env.step_mdp(env.step(policy(data)))
    before = data["history"].clone()
    stepped = env.step(policy(data).set("_step", torch.tensor([True, False])))
    after = stepped["next", "history"]
    assert (after[1] == before[1]).all()
    # The row that was stepped goes on as in a step of both.
    whole = env.step(stepped.exclude("next", "_step").clone())["next", "history"]
    assert (after[0] == whole[0]).all() and (whole[1] != before[1]).any()


def test_a_copy_in_another_environment():
    made = policy_transforms(PastPrior(2))
    TransformedEnv(CountingEnv(5), made).reset()
    env = TransformedEnv(GymEnv("Pendulum-v1"), made.clone())  # one action dimension fewer
    assert env.rollout(3)[keys.ACTIONS].shape == (3, 2, 1)


def test_renamed_keys():
    step_keys = {"chunk_key": "plan", "executed_key": "done_of_it"}
    history = ActionHistory(2, **step_keys)
    env = TransformedEnv(CountingEnv(5), Compose(ChunkStep(2, **step_keys), history))
    check_env_specs(env)
    rollout = env.rollout(3)
    assert torch.equal(rollout[keys.ACTIONS][1:], rollout["plan"][:-1])


def test_outside_environments_nothing_happens():
    data = TensorDict({"a": torch.zeros(3)}, [3])
    assert ActionHistory(3)(data) is data


# ------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    "order", [[ActionHistory(3)], [ActionHistory(3), ChunkStep(3)]], ids=["alone", "before"]
)
def test_without_chunk_step_before_it(order):
    env = TransformedEnv(CountingEnv(5), Compose(*(t.clone() for t in order)))
    with pytest.raises(KeyError, match="append it after ChunkStep"):
        env.reset()


def test_another_key_of_executed_steps():
    env = TransformedEnv(CountingEnv(5), Compose(ChunkStep(3), ActionHistory(3, executed_key="other")))
    with pytest.raises(KeyError, match="found no 'other' after the step: append it after ChunkStep"):
        env.rollout(2)


def test_a_step_without_the_history():
    env = TransformedEnv(CountingEnv(5), policy_transforms(PastPrior(3)))
    data = env.rand_action(env.reset())
    with pytest.raises(KeyError, match=r"ActionHistory found no 'history'.*hand over what the res"):
        env.step(data.exclude("history"))


def test_lengths_that_do_not_go_together():
    with pytest.raises(ValueError, match="history_length must be at least 1, got 0"):
        ActionHistory(0)
    # More executed than remembered.
    env = TransformedEnv(CountingEnv(9), Compose(ChunkStep(3), ActionHistory(2)))
    with pytest.raises(ValueError, match=r"executed 3 actions, but .* remembers 2 .* 0 and 2"):
        env.rollout(2)
    # An environment made for another prior, and a policy that meets it.
    env = TransformedEnv(CountingEnv(9), policy_transforms(PastPrior(3)))
    actor = WarmPriorActor(VelocityMLP(ACTION_DIM, 4, 6, hidden_dim=8), PreviewPrior(3), nfe=1)
    told = r'PreviewPrior.*needs 3 .*forecasts of 6.*"forecast"\) has 3: make windows and env'
    with pytest.raises(ValueError, match=told):
        env.rollout(2, actor)
    with pytest.raises(ValueError, match=r"expects a chunk \[\*B, 3, d_a\].* found shape \(6, 2\)"):
        env.rollout(2, random_policy(6))


# --------------------------------------------------------------- what the network sees of the history


def test_the_last_actions_are_part_of_the_observation():
    """Flattened, once there are ``H``, and whether there are; the same in windows and environments."""
    prior = GaussianPrior(3)
    env = TransformedEnv(
        CountingEnv(9), policy_transforms(prior, observation_steps=2, see_history=True, execute=2)
    )
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


def test_it_conditions_the_network_and_not_the_source():
    prior = GaussianPrior(3)
    torch.manual_seed(0)
    network = VelocityMLP(ACTION_DIM, 4 + HistoryObservation.width(3, ACTION_DIM), 3, hidden_dim=8)
    with torch.no_grad():
        network.head[1].weight.normal_()
    actor = WarmPriorActor(network, prior, nfe=2, observation_key=keys.CONDITIONED)
    data = TensorDict({"observation": torch.randn(8, 2, 4)}, [8])
    found = []
    for shift in (0.0, 1.0):
        data["history"] = random_history(prior, 8)
        data[keys.ACTIONS] = data[keys.ACTIONS] + shift
        observed = HistoryObservation()(data.clone())
        found.append(actor(observed, generator=torch.Generator().manual_seed(1)))
    cold = data[keys.STEPS].squeeze(-1) == 0
    one, two = (out["vla_action", "chunk"] for out in found)
    assert torch.equal(one[cold], two[cold]) and not torch.isclose(one, two)[~cold].all(-1).any()
    noise = torch.randn(8, 3, ACTION_DIM, generator=torch.Generator().manual_seed(1))
    assert all(torch.equal(out["prior", "noise"], noise) for out in found)


def test_keys_that_it_lacks_are_named():
    data = TensorDict({"observation": torch.zeros(1, 2, 4)}, [1])
    with pytest.raises(KeyError, match=r"HistoryObservation needs .*missing: .*'actions'.*'steps'"):
        HistoryObservation()(data)
    env = TransformedEnv(CountingEnv(5), HistoryObservation())
    with pytest.raises(KeyError, match=r"missing: .*'actions'.*append it after ActionHistory"):
        _ = env.observation_spec
    actor = WarmPriorActor(VelocityMLP(ACTION_DIM, 11, 3), GaussianPrior(3), observation_key=keys.CONDITIONED)
    data["history"] = random_history(GaussianPrior(3), 1)
    with pytest.raises(KeyError, match=r"missing: \[\('prior', 'observation'\)\]"):
        actor(data)


# ------------------------------------------------------------------------------------ a prior of one's own


class Momentum(Prior):
    """Goes on as the last two actions did."""

    name = "momentum-of-the-tests"
    default_sigma = 0.0

    def mean(self, history):
        actions = history["actions"]
        ahead = torch.arange(1, self.prediction_length + 1).view(-1, 1)
        last, before = actions[..., -1:, :], actions[..., -2:-1, :]
        loc = last + ahead * (last - before)
        return loc, (history["steps"] >= 2).unsqueeze(-1).expand(*loc.shape[:-1], 1)


LENGTHS = (5, 9, 23)


def momentum_env(place):
    def one(length):
        return TransformedEnv(CountingEnv(length), policy_transforms(Momentum(4), execute=1))

    batched = SerialEnv if "serial" in place else partial(ParallelEnv, mp_start_method="fork")
    if place.endswith("inside"):
        return batched(3, [partial(one, n) for n in LENGTHS])
    base = batched(3, [partial(CountingEnv, n) for n in LENGTHS])
    return TransformedEnv(base, policy_transforms(Momentum(4), execute=1))


@pytest.mark.parametrize("place", ["serial-outside", "serial-inside", "parallel-outside", "parallel-inside"])
def test_every_decision_meets_the_mean_of_its_training_window(place):
    """To the bit, with one action per decision, rows that rest and rows that begin anew whenever."""
    prior, policy = Momentum(4), random_policy(4)
    g = torch.Generator().manual_seed(0)
    env, episodes, decisions = momentum_env(place), [[[]], [[]], [[]]], []
    try:
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
    finally:
        env.close()
    warm = 0
    for row, episode, frame, (loc, scale, mask) in decisions:
        actions = torch.stack(episodes[row][episode])
        demonstration = {"observation": torch.zeros(len(actions), 1), "action": actions}
        demonstration["episode"] = torch.zeros(len(actions), dtype=torch.int64)
        window = ActionWindow(TensorDict(demonstration, [len(actions)]), 4)
        history = window(TensorDict({"frame": torch.tensor(frame)}))["history"]
        expected = prior.distribution(history)
        assert torch.equal(loc, expected.loc) and torch.equal(scale, expected.scale)
        assert torch.equal(mask, expected.warm) and mask.all() == mask.any() == (frame >= 2)
        warm += bool(mask.all())
    assert len(decisions) > 70 and warm > 40


def test_it_trains_and_rolls_out_like_any_other():
    torch.manual_seed(0)
    time = torch.arange(200) % 40
    data = TensorDict(
        {
            "observation": torch.stack([time / 40, time * 0, time * 0, time * 0], -1).float(),
            "action": torch.stack([time / 40, -time / 40], -1),
            "episode": torch.arange(200) // 40,
        },
        [200],
    )
    prior = Momentum(4)
    actor = WarmPriorActor(VelocityMLP(2, 4, 4, hidden_dim=16), prior, nfe=1)
    buffer = window_replay_buffer(data, prior, batch_size=64)
    batch = buffer.sample()
    loc, _, warm = prior.distribution(batch["history"])
    inside = warm.all(1).squeeze(-1) & ~batch["action_is_pad"].any(-1)
    target = batch["vla_action", "chunk"][inside]
    torch.testing.assert_close(loc[inside], target, atol=1e-5, rtol=0)
    loss = FlowMatchingLoss(actor)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    losses = []
    for _ in range(60):
        value = loss(buffer.sample())["loss_flow_matching"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        losses.append(value.item())
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
    env = TransformedEnv(CountingEnv(11), policy_transforms(prior))
    check_env_specs(env)
    rollout = env.rollout(5, actor)
    chunk, ahead = rollout["vla_action", "chunk"], torch.arange(1, 5).view(-1, 1)
    expected = chunk[:-1, -1:] + ahead * (chunk[:-1, -1:] - chunk[:-1, -2:-1])
    torch.testing.assert_close(rollout["prior", "loc"][1:], expected)


class Shifted(PastPrior, nn.Module):
    """A prior that learns something that its means depend on."""

    name = "shifted-of-the-tests"

    def __init__(self, chunk_length):
        nn.Module.__init__(self)
        super().__init__(chunk_length)
        self.shift = nn.Parameter(torch.full((ACTION_DIM,), 0.25))

    def mean(self, history):
        loc, warm = super().mean(history)
        return loc + self.shift, warm


def test_an_environment_holds_nothing_of_a_learned_prior():
    prior = Shifted(2)
    env = TransformedEnv(CountingEnv(9), policy_transforms(prior))
    prior.to(torch.float64)
    assert not list(env.parameters()) and env.rollout(3)[keys.ACTIONS].dtype == torch.float32
