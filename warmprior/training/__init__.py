"""Behaviour cloning, evaluation and worker processes."""

from warmprior.io.workers import WorkerError
from warmprior.training.behaviour_cloning import BehaviourCloning, precondition
from warmprior.training.evaluation import Episode, evaluate, parallel_env, play_episode
from warmprior.training.film import Filmstrip, record_filmstrip, record_video
from warmprior.training.optim import ema_of, make_optimizer, warmup_cosine
from warmprior.training.saved import check_saveable, load_policy, push_policy, save_policy
from warmprior.training.training_config import TrainingConfig

__all__ = [
    "BehaviourCloning",
    "Episode",
    "Filmstrip",
    "TrainingConfig",
    "WorkerError",
    "check_saveable",
    "ema_of",
    "evaluate",
    "load_policy",
    "make_optimizer",
    "parallel_env",
    "play_episode",
    "precondition",
    "push_policy",
    "record_filmstrip",
    "record_video",
    "save_policy",
    "warmup_cosine",
]
