"""A tiny behaviour cloning with dropout, whose every draw has to be restored."""

import pytest
import torch
from torch import nn

from tests.states import copied
from tests.toy_env import demonstrations
from warmprior import ChiTransformer, PastPrior, VelocityMLP, WarmPriorActor
from warmprior.training import BehaviourCloning, TrainingConfig

SAVES = {"checkpoints": 2, "save_every": 7, "log_every": 10}
CONFIG = TrainingConfig(iterations=40, batch_size=16, learning_rate=1e-2, cold_probability=0.25, **SAVES)


def dataset():
    return demonstrations(120, 30)


def actor_for(prior=None, network=None):
    prior = PastPrior(4) if prior is None else prior
    torch.manual_seed(7)
    if network is None:  # with dropout: the global generator has to be restored too
        sizes = {"hidden_dim": 8, "num_layers": 1, "num_heads": 2}
        network = ChiTransformer(2, 3, prior.prediction_length, dropout=0.2, **sizes)
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
    parts = nn.ModuleDict({"net": cloning.actor.network, "ema": cloning.update.ema})
    return copied(parts.state_dict())


def finished(folder, *args, **options):
    cloning = training(folder, *args, **options)
    cloning.run(None)
    return cloning


def mlp():
    torch.manual_seed(3)
    return VelocityMLP(2, 3, 4, hidden_dim=8)
