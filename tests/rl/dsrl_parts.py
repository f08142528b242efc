"""A small DSRL-NA loss and a batch for it, with every kind of episode end."""

import torch
from tensordict import TensorDict
from torchrl.objectives import ValueEstimators

from tests.toy_env import mlp_actor
from warmprior import (
    DSRLNALoss,
    PastPrior,
    PriorDecoder,
    keys,
    make_prior_space_actor,
    make_prior_space_critic,
)

H, D_A, D_O, TO, N = 2, 2, 3, 2, 6
GAMMA = 0.9


def make_decoder(prior, delta=0.5):
    return PriorDecoder(mlp_actor(prior, D_A, D_O, nfe=2), delta=delta)


def build(prior=None, delta=0.5, decoder=None, hidden_dim=8, critics=2, **options):
    """A loss, and the networks that went into it (lists of critics, all different)."""
    prior = PastPrior(H) if prior is None else prior
    decoder = make_decoder(prior, delta) if decoder is None else decoder
    sizes = (D_A, D_O, prior.prediction_length, TO)
    torch.manual_seed(0)
    actor = make_prior_space_actor(*sizes, delta=decoder.delta, hidden_dim=hidden_dim)
    chunk = [
        make_prior_space_critic(*sizes, in_keys=(keys.OBSERVATION, keys.CHUNK), hidden_dim=hidden_dim)
        for _ in range(critics)
    ]
    noise = [
        make_prior_space_critic(*sizes, delta=decoder.delta, hidden_dim=hidden_dim) for _ in range(critics)
    ]
    loss = DSRLNALoss(actor, chunk, noise, decoder, **options)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    return loss


def batch(prior=None):
    prior = PastPrior(H) if prior is None else prior
    torch.manual_seed(3)
    chunk = (N, prior.prediction_length, D_A)

    def state():
        return {"observation": torch.randn(N, TO, D_O), "prior": {"anchor": torch.randn(chunk)}}

    def flag(rows):
        value = torch.zeros(N, 1, dtype=torch.bool)
        value[rows] = True
        return value

    terminated, truncated = flag([0]), flag([1])
    ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    executed = torch.tensor([[1], [2], [2], [1], [2], [2]])
    after = {**state(), **ends, "reward": torch.randn(N, 1), "executed_steps": executed}
    stale = torch.full_like(executed, 7)  # the step before: must not be read
    before = {**state(), "vla_action": {"chunk": torch.randn(chunk)}, "executed_steps": stale}
    return TensorDict({**before, "next": after}, [N])
