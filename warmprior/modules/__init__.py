"""Priors, velocity networks and the actor."""

from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.baselines import HistoryPrior, RegressionPrior
from warmprior.modules.chi_transformer import ChiTransformer
from warmprior.modules.interpolant import (
    Interpolant,
    LinearInterpolant,
    PolynomialInterpolant,
    TrigonometricInterpolant,
)
from warmprior.modules.mlp import VelocityMLP
from warmprior.modules.network import TimestepEmbedding, VelocityNetwork
from warmprior.modules.normalize import Normalizer
from warmprior.modules.ode import ODEActor, integrate
from warmprior.modules.preconditioning import PreconditionedNetwork, SourceMoments
from warmprior.modules.prior import Prior
from warmprior.modules.priors import GaussianPrior, PastPrior, PreviewPrior
from warmprior.modules.sampler import PriorSampler
from warmprior.modules.trend import PoseTrend, RestingAction

__all__ = [
    "ChiTransformer",
    "GaussianPrior",
    "HistoryPrior",
    "Interpolant",
    "LinearInterpolant",
    "Normalizer",
    "ODEActor",
    "PastPrior",
    "PolynomialInterpolant",
    "PoseTrend",
    "PreconditionedNetwork",
    "PreviewPrior",
    "Prior",
    "PriorSampler",
    "RegressionPrior",
    "RestingAction",
    "SourceMoments",
    "TimestepEmbedding",
    "TrigonometricInterpolant",
    "VelocityMLP",
    "VelocityNetwork",
    "WarmPriorActor",
    "integrate",
]
