"""Behaviour cloning, evaluation and worker processes."""

from warmprior.io.workers import WorkerError
from warmprior.training.behaviour_cloning import BehaviourCloning
from warmprior.training.card import model_card, policy_results
from warmprior.training.evaluation import Episode, evaluate, parallel_env, play_episode
from warmprior.training.film import Filmstrip, record_filmstrip
from warmprior.training.navigation import judge_navigation, play_navigation
from warmprior.training.optim import ema_of, warmup_cosine
from warmprior.training.options import DataOptions, NetworkOptions, TrainingConfig
from warmprior.training.saved import load_policy, push_policy, save_policy
from warmprior.training.task import Task, load_task, navigation_task
from warmprior.training.train import precondition, train_policy

__all__ = [
    "BehaviourCloning",
    "DataOptions",
    "Episode",
    "Filmstrip",
    "NetworkOptions",
    "Task",
    "TrainingConfig",
    "WorkerError",
    "ema_of",
    "evaluate",
    "judge_navigation",
    "load_policy",
    "load_task",
    "model_card",
    "navigation_task",
    "parallel_env",
    "play_episode",
    "play_navigation",
    "policy_results",
    "precondition",
    "push_policy",
    "record_filmstrip",
    "save_policy",
    "train_policy",
    "warmup_cosine",
]
