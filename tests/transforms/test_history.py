"""ActionHistory against lists of executed actions, with any number executed per decision."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.toy_env import ACTION_DIM, ChunkPolicy, CountingEnv
from warmprior import (
    ActionHistory,
    ChunkStep,
    FlowMatchingLoss,
    GaussianPrior,
    PastPrior,
    PreviewPrior,
    Prior,
    VelocityMLP,
    WarmPriorActor,
    policy_transforms,
    window_replay_buffer,
)

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]


def chunk_step(prior, **options):
    return ChunkStep(prior.chunk_length, prediction_length=prior.prediction_length, **options)


def random_policy(prior, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def chunk(data):
        shape = (*data.batch_size, prior.prediction_length, ACTION_DIM)
        return torch.rand(shape, generator=generator) * 2 - 1

    return ChunkPolicy(chunk)


@settings(max_examples=20, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=3),
    horizon=st.integers(1, 5),
    data=st.data(),
    prior_class=st.sampled_from(PRIORS),
)
def test_mean_is_the_list_of_executed_actions(lengths, horizon, data, prior_class):
    execute = data.draw(st.integers(1, horizon))
    prior = prior_class(horizon)
    base = SerialEnv(len(lengths), [partial(CountingEnv, n) for n in lengths])
    env = TransformedEnv(base, Compose(chunk_step(prior, execute=execute), ActionHistory(prior)))
    rollout = env.rollout(10, random_policy(prior), break_when_any_done=False)
    for row, length in zip(rollout, lengths, strict=True):
        executed: list[torch.Tensor] = []
        forecast = None
        for t in range(10):
            step = row[t]
            assert step["prior", "elapsed"].item() == len(executed)
            assert step["observation"][0] == len(executed)
            expected = None
            if prior_class is PastPrior and len(executed) >= horizon:
                expected = executed[-horizon:]
            if prior_class is PreviewPrior and forecast is not None:
                expected = forecast
            warm = step["prior", "warm"].squeeze(-1)
            assert warm[:horizon].all() == warm[:horizon].any() == (expected is not None)
            assert not warm[horizon:].any()
            if expected is not None:
                assert torch.equal(step["prior", "loc"][:horizon], torch.stack(list(expected)))
            chunk = step["vla_action", "chunk"]
            k = min(execute, length - len(executed))
            executed += list(chunk[:k])
            forecast = chunk[k : k + horizon]
            if len(executed) == length:
                executed, forecast = [], None
    env.close()


@pytest.mark.parametrize("prior_class", PRIORS)
@pytest.mark.parametrize("horizon", [1, 4])
def test_specs_and_cold_reset(prior_class, horizon):
    prior = prior_class(horizon)
    env = TransformedEnv(
        SerialEnv(2, partial(CountingEnv, 9)), Compose(chunk_step(prior), ActionHistory(prior))
    )
    check_env_specs(env)
    data = env.reset()
    assert data["prior", "loc"].shape == (2, prior.prediction_length, ACTION_DIM)
    assert not data["prior", "warm"].any() and not data["prior", "loc"].any()
    assert not data["prior", "elapsed"].any()


def test_one_environment_may_reset_alone():
    prior = PastPrior(2)
    base = SerialEnv(2, [partial(CountingEnv, n) for n in (2, 9)])
    env = TransformedEnv(base, Compose(chunk_step(prior), ActionHistory(prior)))
    policy = random_policy(prior)
    data = env.step(policy(env.reset()))
    kept = data["next", "prior", "loc"][1].clone()
    data = env.step_mdp(data)
    data = env.reset(data.set("_reset", torch.tensor([[True], [False]])))
    assert not data["prior", "warm"][0].any() and data["prior", "warm"][1].all()
    assert torch.equal(data["prior", "loc"][1], kept)
    assert data["prior", "elapsed"].flatten().tolist() == [0, 2]


def test_without_chunk_step():
    with pytest.raises(KeyError, match="append it after ChunkStep"):
        TransformedEnv(CountingEnv(5), ActionHistory(PastPrior(3))).reset()


def test_another_key_of_executed_steps():
    env = TransformedEnv(
        CountingEnv(5), Compose(ChunkStep(3), ActionHistory(PastPrior(3), executed_key="other"))
    )
    with pytest.raises(
        KeyError, match="found no 'other' after the step: append it after ChunkStep"
    ):
        env.rollout(2)


def test_a_prior_s_mask_is_not_cast():
    class Grey(PastPrior):
        name = "grey-of-the-tests"

        def next_mean(self, loc, chunk, executed_steps, elapsed_steps):
            loc, warm = super().next_mean(loc, chunk, executed_steps, elapsed_steps)
            return loc, 0.3 * warm

    with pytest.raises(AssertionError, match="bool"):
        check_env_specs(TransformedEnv(CountingEnv(5), policy_transforms(Grey(3))))


def test_before_chunk_step():
    env = TransformedEnv(CountingEnv(5), Compose(ActionHistory(PastPrior(3)), ChunkStep(3)))
    with pytest.raises(KeyError, match="after ChunkStep"):
        env.rollout(2)


def test_step_without_the_mean():
    env = TransformedEnv(CountingEnv(5), policy_transforms(PastPrior(3)))
    data = env.rand_action(env.reset())
    with pytest.raises(KeyError, match=r"ActionHistory found no .*loc.*hand over what the reset"):
        env.step(data.exclude("prior"))


def test_prior_of_another_prediction_length():
    with pytest.raises(
        ValueError, match=r"takes chunks of 3 actions, but PreviewPrior.* predicts 6: use ChunkStep"
    ):
        TransformedEnv(
            CountingEnv(5), Compose(ChunkStep(3), ActionHistory(PreviewPrior(3)))
        ).reset()


def test_renamed_keys():
    prior = PastPrior(2)
    step_keys = {"chunk_key": "plan", "executed_key": "done_of_it"}
    history = ActionHistory(
        prior, loc_key="mean", warm_key=("is", "warm"), elapsed_key="age", **step_keys
    )
    env = TransformedEnv(CountingEnv(5), Compose(ChunkStep(2, **step_keys), history))
    check_env_specs(env)
    assert env.observation_spec["age"].dtype == torch.int64
    assert env.observation_spec["is", "warm"].dtype == torch.bool
    rollout = env.rollout(3)
    assert torch.equal(rollout["mean"][1:], rollout["plan"][:-1])
    assert rollout["age"].flatten().tolist() == [0, 2, 4]
    assert rollout["is", "warm"].all(1).flatten().tolist() == [False, True, True]


class Shifted(PastPrior, nn.Module):
    """A prior that learns something that its means depend on."""

    name = "shifted-of-the-tests"

    def __init__(self, chunk_length):
        nn.Module.__init__(self)
        super().__init__(chunk_length)
        self.shift = nn.Parameter(torch.full((ACTION_DIM,), 0.25))

    def next_mean(self, loc, chunk, executed_steps, elapsed_steps):
        loc, warm = super().next_mean(loc, chunk, executed_steps, elapsed_steps)
        return loc + self.shift, warm


@pytest.mark.parametrize("to", [torch.float64, torch.device("meta")])
def test_moving_a_learned_prior_or_its_environment_leaves_the_other(to):
    """ "meta" stands for a GPU: nothing on it can meet the environment's tensors."""
    prior = Shifted(2)
    env = TransformedEnv(CountingEnv(9), Compose(ChunkStep(2), ActionHistory(prior)))
    prior.to(to)
    rollout = env.rollout(3)
    expected = rollout["vla_action", "chunk"][:-1] + 0.25
    assert torch.equal(rollout["prior", "loc"][1:], expected)
    assert not list(p for p in env.parameters() if p.requires_grad)
    prior = Shifted(2)
    ActionHistory(prior).to(to)
    assert (prior.shift.dtype, prior.shift.device.type) == (torch.float32, "cpu")
    assert prior.shift.requires_grad


def test_outside_environments_nothing_happens():
    data = TensorDict({"a": torch.zeros(3)}, [3])
    assert ActionHistory(PastPrior(3))(data) is data


def test_a_user_s_prior_from_window_to_environment():
    """Momentum: the mean continues the last two actions in a straight line."""

    class Momentum(Prior):
        name = "momentum-for-this-test"
        default_sigma = 0.0

        def _extrapolate(self, before, last, length):
            ahead = torch.arange(1, length + 1).view(-1, 1)
            return last + ahead * (last - before)

        def training_mean(self, history, history_valid, target):
            warm = history_valid[..., -2:].all(-1)[..., None, None].expand_as(target[..., :1])
            mean = self._extrapolate(history[..., -2:-1, :], history[..., -1:, :], target.shape[-2])
            return torch.where(warm, mean, 0.0), warm

        def next_mean(self, loc, chunk, executed_steps, elapsed_steps):
            both = chunk.gather(-2, self.positions(executed_steps - 2, chunk, 2))
            mean = self._extrapolate(both[..., :1, :], both[..., 1:, :], chunk.shape[-2])
            return mean, torch.ones_like(chunk[..., :1], dtype=torch.bool)

    try:
        torch.manual_seed(0)
        n = 200
        time = torch.arange(n) % 40
        data = TensorDict(
            {
                "observation": torch.stack([time / 40, time * 0, time * 0, time * 0], -1).float(),
                "action": torch.stack([time / 40, -time / 40], -1),
                "episode": torch.arange(n) // 40,
            },
            [n],
        )
        prior = Momentum(4)
        network = VelocityMLP(2, 4, 4, hidden_dim=16)
        actor = WarmPriorActor(network, prior, nfe=1)
        buffer = window_replay_buffer(data, prior, batch_size=64)
        batch = buffer.sample()
        inside = batch["prior", "warm"].all(1).squeeze(-1) & ~batch["action_is_pad"].any(-1)
        torch.testing.assert_close(
            batch["prior", "loc"][inside], batch["vla_action", "chunk"][inside], atol=1e-5, rtol=0
        )
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
        chunk = rollout["vla_action", "chunk"]
        for t in range(1, rollout.shape[0]):
            for tau in range(4):
                last, before = chunk[t - 1, 3], chunk[t - 1, 2]
                torch.testing.assert_close(
                    rollout["prior", "loc"][t, tau], last + (tau + 1) * (last - before)
                )
    finally:
        del Prior._registry["momentum-for-this-test"]


@pytest.mark.parametrize("prior_class", PRIORS)
@pytest.mark.parametrize("execute", [2, 3])
def test_rows_that_rest_keep_their_mean(prior_class, execute):
    """Outside of workers a partial step comes with chunks for all rows; those that rest execute none."""
    prior = prior_class(3)
    base = SerialEnv(2, partial(CountingEnv, 30))
    env = TransformedEnv(base, Compose(chunk_step(prior, execute=execute), ActionHistory(prior)))
    policy = random_policy(prior)
    data = env.reset()
    for _ in range(2):
        data = env.step_mdp(env.step(policy(data)))
    before = data["prior"].clone()
    stepped = env.step(policy(data).set("_step", torch.tensor([True, False])))
    after = stepped["next", "prior"]
    for key in ("loc", "warm", "elapsed"):
        assert torch.equal(after[key][1], before[key][1]), key
    assert after["elapsed"].flatten().tolist() == [3 * execute, 2 * execute]
    # The row that was stepped goes on as in a step of both.
    whole = env.step(stepped.exclude("next", "_step").clone())["next", "prior"]
    assert torch.equal(after["loc"][0], whole["loc"][0])
    assert torch.equal(after["warm"][0], whole["warm"][0])
