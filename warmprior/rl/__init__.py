"""Reinforcement learning in the source space of a frozen policy."""

from warmprior.rl.anchor import PriorAnchor
from warmprior.rl.box_normal import BoxTanhNormal
from warmprior.rl.config import PriorSpaceConfig
from warmprior.rl.decoder import PriorDecoder
from warmprior.rl.dsrl import DSRLNALoss
from warmprior.rl.environment import PriorSpace
from warmprior.rl.networks import make_prior_space_actor, make_prior_space_critic
from warmprior.rl.replay_segments import ReplaySegments
from warmprior.rl.residual import ResidualSampler
from warmprior.rl.training import PriorSpaceTraining

__all__ = [
    "BoxTanhNormal",
    "DSRLNALoss",
    "PriorAnchor",
    "PriorDecoder",
    "PriorSpace",
    "PriorSpaceConfig",
    "PriorSpaceTraining",
    "ReplaySegments",
    "ResidualSampler",
    "make_prior_space_actor",
    "make_prior_space_critic",
]
