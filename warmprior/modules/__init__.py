"""Priors, velocity networks and the actor."""

from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.baselines import HistoryPrior, RegressionPrior
from warmprior.modules.box_normal import BoxTanhNormal
from warmprior.modules.chi_transformer import ChiTransformer
from warmprior.modules.decoder import PriorDecoder
from warmprior.modules.interpolant import (
    Interpolant,
    LinearInterpolant,
    PolynomialInterpolant,
    TrigonometricInterpolant,
)
from warmprior.modules.mlp import VelocityMLP
from warmprior.modules.network import TimestepEmbedding, VelocityNetwork
from warmprior.modules.ode import ODEActor, integrate
from warmprior.modules.preconditioning import PreconditionedNetwork, SourceMoments
from warmprior.modules.prior import Prior
from warmprior.modules.prior_space import make_prior_space_actor, make_prior_space_critic
from warmprior.modules.priors import GaussianPrior, PastPrior, PreviewPrior
from warmprior.modules.residual import ResidualSampler
from warmprior.modules.sampler import PriorSampler

__all__ = [
    "BoxTanhNormal",
    "ChiTransformer",
    "GaussianPrior",
    "HistoryPrior",
    "Interpolant",
    "LinearInterpolant",
    "ODEActor",
    "PastPrior",
    "PolynomialInterpolant",
    "PreconditionedNetwork",
    "PreviewPrior",
    "Prior",
    "PriorDecoder",
    "PriorSampler",
    "RegressionPrior",
    "ResidualSampler",
    "SourceMoments",
    "TimestepEmbedding",
    "TrigonometricInterpolant",
    "VelocityMLP",
    "VelocityNetwork",
    "WarmPriorActor",
    "integrate",
    "make_prior_space_actor",
    "make_prior_space_critic",
]
