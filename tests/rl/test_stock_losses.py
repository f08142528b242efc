"""TorchRL's own losses, unmodified, through the decoder: gradients, discounts of short chunks, frozenness."""

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import RenameTransform
from torchrl.objectives import CrossQLoss, REDQLoss, SACLoss, SoftUpdate, TQCLoss, ValueEstimators

from tests.rl.test_environment import D_O, DELTA, TO, H, make_decoder, make_env
from tests.states import copied, same
from tests.toy_env import ACTION_DIM
from warmprior import PreviewPrior, keys, make_prior_space_actor, make_prior_space_critic

GAMMA = 0.9
PRIOR = PreviewPrior(H)
SIZES = (ACTION_DIM, D_O, PRIOR.prediction_length, TO)
LOG_PROB = ("prior", "delta_log_prob")
LOSSES = [SACLoss, REDQLoss, CrossQLoss, TQCLoss]


def make_loss(loss_class):
    torch.manual_seed(0)
    actor = make_prior_space_actor(*SIZES, delta=DELTA, hidden_dim=8)
    quantiles = {"out_features": 5} if loss_class is TQCLoss else {}
    critic = make_prior_space_critic(*SIZES, delta=DELTA, hidden_dim=8, **quantiles)
    loss = loss_class(actor, critic, target_entropy=0.0)
    if loss_class is REDQLoss:
        loss.set_keys(action=keys.DELTA, sample_log_prob=LOG_PROB)
    if loss_class is CrossQLoss:
        loss.set_keys(action=keys.DELTA, log_prob=LOG_PROB)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    if loss_class is REDQLoss:
        loss.value_estimator.set_keys(steps_to_next_obs=("next", keys.EXECUTED))
    return actor, loss


def make_buffer():
    """A transition's own count of steps where the losses look for it."""
    steps = RenameTransform([("next", keys.EXECUTED)], ["steps_to_next_obs"], create_copy=True)
    return TensorDictReplayBuffer(storage=LazyTensorStorage(200), batch_size=16, transform=steps)


@pytest.mark.parametrize("wiring", ["policy", "environment"])
@pytest.mark.parametrize("loss_class", LOSSES)
def test_training_loop(loss_class, wiring):
    decoder = make_decoder(PRIOR)
    before = copied(decoder.state_dict())
    actor, loss = make_loss(loss_class)
    if wiring == "policy":
        env, policy = make_env(PRIOR, gamma=GAMMA), TensorDictSequential(actor, decoder)
    else:
        env, policy = make_env(PRIOR, decoder, gamma=GAMMA), actor
    collector = Collector(env, policy, frames_per_batch=16, total_frames=48)
    collector.set_seed(0)
    buffer = make_buffer()
    updater = None if loss_class is CrossQLoss else SoftUpdate(loss, tau=0.1)
    parameters = dict(loss.named_parameters())
    optimizer = torch.optim.Adam(parameters.values(), lr=1e-2)
    start = {name: p.detach().clone() for name, p in parameters.items()}
    for data in collector:
        buffer.extend(data.reshape(-1))
        losses = loss(buffer.sample())
        optimizer.zero_grad()
        sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
        assert all(p.grad is not None for p in parameters.values())
        optimizer.step()
        if updater is not None:
            updater.step()
    collector.shutdown()
    assert all(torch.isfinite(p).all() for p in parameters.values())
    moved = {name for name, p in parameters.items() if not torch.equal(p, start[name])}
    assert {name.split(".")[0] for name in moved} == {name.split(".")[0] for name in parameters}
    assert same(before, decoder.state_dict())
    assert not any(p.requires_grad for p in decoder.parameters())


def watched(loss, sample, monkeypatch):
    """What the loss hands to its value estimator and gets back: reward, next value, target."""
    seen = []
    original = type(loss.value_estimator).value_estimate

    def spy(self, tensordict, *args, next_value=None, **kwargs):
        out = original(self, tensordict, *args, next_value=next_value, **kwargs)
        if next_value is None:
            next_value = tensordict["next", self.tensor_keys.value]
        seen.append((tensordict["next", "reward"], next_value, out))
        return out

    with monkeypatch.context() as patch:
        patch.setattr(type(loss.value_estimator), "value_estimate", spy)
        loss(sample)
    (result,) = seen
    return result


@pytest.mark.parametrize("loss_class", LOSSES)
def test_discount_of_short_chunks(loss_class, monkeypatch):
    """What each loss bootstraps from, compared with reward + gamma^k * value written by hand.

    The toy truncates inside chunks, so values after one and three executed steps both count.
    """
    actor, loss = make_loss(loss_class)
    if loss_class is not CrossQLoss:
        SoftUpdate(loss, tau=0.1)
    env = make_env(PRIOR, truncate=True, gamma=GAMMA)
    env.set_seed(0)
    policy = TensorDictSequential(actor, make_decoder(PRIOR))
    data = env.rollout(12, policy, break_when_any_done=False)
    buffer = make_buffer()
    buffer.extend(data.reshape(-1))
    sample = buffer.sample(200)
    k = sample["next", "executed_steps"]
    assert set(k.flatten().tolist()) == {1, 3} and not sample["next", "terminated"].any()
    assert not torch.equal(k, sample["executed_steps"])  # at the root: the step before

    reward, value, target = watched(loss, sample, monkeypatch)
    torch.testing.assert_close(target, reward + GAMMA ** k.float() * value, rtol=1e-5, atol=1e-5)
    assert (value != 0).all()
    # The reward is the chunk's own discounted sum: the toy pays t at control step t.
    time = sample["observation"][:, -1, :1]
    paid = sum(GAMMA**i * (time + i + 1) * (i < k) for i in range(H))
    torch.testing.assert_close(sample["next", "reward"], paid)

    # Time-outs as terminations, the official reading.
    loss.set_keys(terminated="done")
    reward, value, target = watched(loss, sample, monkeypatch)
    goes_on = ~sample["next", "done"]
    assert goes_on.any() and not goes_on.all()
    expected = reward + GAMMA ** k.float() * goes_on * value
    torch.testing.assert_close(target, expected, rtol=1e-5, atol=1e-5)
