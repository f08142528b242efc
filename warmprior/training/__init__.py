"""Behaviour cloning, evaluation and worker processes."""

from warmprior.io.workers import WorkerError
from warmprior.training.behaviour_cloning import BehaviourCloning, precondition
from warmprior.training.evaluation import Episode, evaluate, parallel_env, play_episode
from warmprior.training.film import Filmstrip, record_filmstrip, record_video
from warmprior.training.optim import ema_of, make_optimizer, warmup_cosine
from warmprior.training.prior_learning import learn_prior
from warmprior.training.training_config import TrainingConfig

__all__ = [
    "BehaviourCloning",
    "Episode",
    "Filmstrip",
    "TrainingConfig",
    "WorkerError",
    "ema_of",
    "evaluate",
    "learn_prior",
    "make_optimizer",
    "parallel_env",
    "play_episode",
    "precondition",
    "record_filmstrip",
    "record_video",
    "warmup_cosine",
]
