"""A tiny behaviour cloning with dropout, whose every draw has to be restored."""

from __future__ import annotations

import pytest
import torch

from tests.toy_env import demonstrations
from warmprior import ChiTransformer, PastPrior, VelocityMLP, WarmPriorActor
from warmprior.training import BehaviourCloning, TrainingConfig

CONFIG = TrainingConfig(
    iterations=40,
    batch_size=16,
    learning_rate=1e-2,
    checkpoints=2,
    save_every=7,
    log_every=10,
    cold_probability=0.25,
)


def dataset():
    return demonstrations(120, 30)


def actor_for(prior=None, network=None):
    prior = PastPrior(4) if prior is None else prior
    torch.manual_seed(7)
    if network is None:  # with dropout: the global generator has to be restored too
        network = ChiTransformer(
            2, 3, prior.prediction_length, embedding_dim=8, num_layers=1, num_heads=2, dropout=0.2
        )
    return WarmPriorActor(network, prior, nfe=2)


def training(folder, config=CONFIG, **options):
    actor = options.pop("actor", None) or actor_for()
    data = options.pop("data", None)
    data = dataset() if data is None else data
    return BehaviourCloning(actor, data, config, folder, **options)


def run_until(cloning, iteration):
    """Run a training until Ctrl-C before the step behind that iteration."""
    step = cloning.step

    def stopping():
        if cloning.iteration == iteration:
            raise KeyboardInterrupt
        return step()

    cloning.step = stopping
    with pytest.raises(KeyboardInterrupt):
        cloning.run(None)


def weights(cloning):
    return {
        **{f"net.{n}": v.clone() for n, v in cloning.actor.network.state_dict().items()},
        **{f"ema.{n}": v.clone() for n, v in cloning.update.ema.state_dict().items()},
    }


def same(one, two):
    return one.keys() == two.keys() and all(torch.equal(one[k], two[k]) for k in one)


def mlp():
    torch.manual_seed(3)
    return VelocityMLP(2, 3, 4, hidden_dim=8)
