"""Behaviour cloning, evaluation and comparisons of priors.

:class:`~warmprior.training.comparison.Comparison` and what it is made of are imported from their
modules: they need ``warmprior[sim]``.
"""

from warmprior.training.behaviour_cloning import BehaviourCloning, precondition
from warmprior.training.evaluation import Episode, evaluate, parallel_env, play_episode
from warmprior.training.filmstrip import Filmstrip, record_filmstrip
from warmprior.training.navigation1d import (
    NAVIGATION_PRESETS,
    NavigationPreset,
    NavigationStudy,
    navigation_priors,
)
from warmprior.training.optim import ema_of, make_optimizer, warmup_cosine
from warmprior.training.presets import PRESETS, Preset
from warmprior.training.training_config import TrainingConfig
from warmprior.training.video import record_video
from warmprior.training.workers import WorkerError

__all__ = [
    "NAVIGATION_PRESETS",
    "PRESETS",
    "BehaviourCloning",
    "Episode",
    "Filmstrip",
    "NavigationPreset",
    "NavigationStudy",
    "Preset",
    "TrainingConfig",
    "WorkerError",
    "ema_of",
    "evaluate",
    "make_optimizer",
    "navigation_priors",
    "parallel_env",
    "play_episode",
    "precondition",
    "record_filmstrip",
    "record_video",
    "warmup_cosine",
]
