"""Behaviour cloning, evaluation and worker processes."""

from warmprior.io.workers import WorkerError
from warmprior.modules.schedule import warmup_cosine
from warmprior.training.behaviour_cloning import BehaviourCloning
from warmprior.training.card import model_card
from warmprior.training.evaluation import Episode, evaluate, play_episode
from warmprior.training.optim import ema_of
from warmprior.training.options import NetworkOptions, TrainingConfig
from warmprior.training.parallel import parallel_env
from warmprior.training.saved import load_policy, push_policy, save_policy
from warmprior.training.task import Task
from warmprior.training.train import precondition, train_policy
from warmprior.training.video import Filmstrip, record_filmstrip

__all__ = [
    "BehaviourCloning",
    "Episode",
    "Filmstrip",
    "NetworkOptions",
    "Task",
    "TrainingConfig",
    "WorkerError",
    "ema_of",
    "evaluate",
    "load_policy",
    "model_card",
    "parallel_env",
    "play_episode",
    "precondition",
    "push_policy",
    "record_filmstrip",
    "save_policy",
    "train_policy",
    "warmup_cosine",
]
