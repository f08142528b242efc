"""Priors, velocity networks and the actor."""

from warmprior.modules.actor import PriorSampler, StartPoint, WarmPriorActor
from warmprior.modules.cvae import CVAEPrior
from warmprior.modules.encoder import ImageEncoder, VisionNetwork, imagenet_weights, load_imagenet
from warmprior.modules.interpolant import Interpolant, LinearInterpolant
from warmprior.modules.mlp import PlainMLP, VelocityMLP
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.normalize import Normalizer
from warmprior.modules.ode import ODEActor, integrate
from warmprior.modules.preconditioning import PreconditionedNetwork, SourceMoments
from warmprior.modules.prior import GaussianPrior, PastPrior, PreviewPrior, Prior
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.sampling import Sampling
from warmprior.modules.source import Source
from warmprior.modules.transformers import AdaLNTransformer, ChiTransformer
from warmprior.modules.trend import RestingAction, RestingJoints, RestingPose, RestingTrend

__all__ = [
    "AdaLNTransformer",
    "CVAEPrior",
    "ChiTransformer",
    "GaussianPrior",
    "ImageEncoder",
    "Interpolant",
    "LinearInterpolant",
    "Normalizer",
    "ODEActor",
    "PastPrior",
    "PlainMLP",
    "PreconditionedNetwork",
    "PreviewPrior",
    "Prior",
    "PriorSampler",
    "RealTimeChunking",
    "RestingAction",
    "RestingJoints",
    "RestingPose",
    "RestingTrend",
    "Sampling",
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
