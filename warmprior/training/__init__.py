"""Behaviour cloning, and the options of its networks and recipes."""

from warmprior.modules.learning_rate import warmup_cosine
from warmprior.options.training import NetworkOptions, TrainingConfig
from warmprior.training.cloning import BehaviourCloning
from warmprior.training.networks import make_network
from warmprior.training.optim import ema_of
from warmprior.training.train import precondition, train_policy

__all__ = [
    "BehaviourCloning",
    "NetworkOptions",
    "TrainingConfig",
    "ema_of",
    "make_network",
    "precondition",
    "train_policy",
    "warmup_cosine",
]
