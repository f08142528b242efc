"""Reinforcement learning in the source space of a frozen policy."""

from warmprior.options.agent import PriorSpaceConfig
from warmprior.rl.anchor import PriorAnchor, has_anchor
from warmprior.rl.decoder import PriorDecoder, PriorSpace, ResidualSampler, residual_reach
from warmprior.rl.dsrl import DSRLNALoss
from warmprior.rl.improve import Improvement, improve_policy
from warmprior.rl.improved import AgentStart, improved_policy
from warmprior.rl.networks import BoxTanhNormal, make_prior_space_actor, make_prior_space_critic
from warmprior.rl.training import PriorSpaceTraining

__all__ = [
    "AgentStart",
    "BoxTanhNormal",
    "DSRLNALoss",
    "Improvement",
    "PriorAnchor",
    "PriorDecoder",
    "PriorSpace",
    "PriorSpaceConfig",
    "PriorSpaceTraining",
    "ResidualSampler",
    "has_anchor",
    "improve_policy",
    "improved_policy",
    "make_prior_space_actor",
    "make_prior_space_critic",
    "residual_reach",
]
