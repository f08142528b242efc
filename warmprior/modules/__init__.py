"""Priors, velocity networks and the actor."""

from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.chi_transformer import ChiTransformer
from warmprior.modules.encoder import ImageEncoder, imagenet_weights, load_imagenet
from warmprior.modules.interpolant import (
    BridgeInterpolant,
    Interpolant,
    LinearInterpolant,
)
from warmprior.modules.mlp import VelocityMLP
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.normalize import Normalizer
from warmprior.modules.ode import ODEActor, integrate
from warmprior.modules.preconditioning import PreconditionedNetwork, SourceMoments
from warmprior.modules.prior import GaussianPrior, PastPrior, PreviewPrior, Prior, Source
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.sampler import PriorSampler
from warmprior.modules.start import StartPoint
from warmprior.modules.trend import PoseTrend, RestingAction
from warmprior.modules.vision import VisionNetwork

__all__ = [
    "BridgeInterpolant",
    "ChiTransformer",
    "GaussianPrior",
    "ImageEncoder",
    "Interpolant",
    "LinearInterpolant",
    "Normalizer",
    "ODEActor",
    "PastPrior",
    "PoseTrend",
    "PreconditionedNetwork",
    "PreviewPrior",
    "Prior",
    "PriorSampler",
    "RealTimeChunking",
    "RestingAction",
    "Source",
    "SourceMoments",
    "StartPoint",
    "VelocityMLP",
    "VelocityNetwork",
    "VisionNetwork",
    "WarmPriorActor",
    "imagenet_weights",
    "integrate",
    "load_imagenet",
]
