"""Priors, velocity networks and the actor."""

from warmprior.modules.a2a import A2APrior
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.baselines import HistoryPrior, RegressionPrior
from warmprior.modules.chi_transformer import ChiTransformer
from warmprior.modules.couplings import OTPrior, ReflowPrior
from warmprior.modules.cvae import CVAEPrior
from warmprior.modules.encoder import ImageEncoder, imagenet_weights, load_imagenet
from warmprior.modules.gaussian_forecast import ForecastPrior, LeapPrior
from warmprior.modules.interpolant import (
    Interpolant,
    LinearInterpolant,
    PolynomialInterpolant,
    TrigonometricInterpolant,
)
from warmprior.modules.learned import LearnedPrior
from warmprior.modules.learning_windows import LearningWindows
from warmprior.modules.mlp import VelocityMLP
from warmprior.modules.network import TimestepEmbedding, VelocityNetwork
from warmprior.modules.normalize import Normalizer
from warmprior.modules.ode import ODEActor, integrate
from warmprior.modules.preconditioning import PreconditionedNetwork, SourceMoments
from warmprior.modules.prior import Prior
from warmprior.modules.priors import GaussianPrior, PastPrior, PreviewPrior
from warmprior.modules.real_time_chunking import RealTimeChunking, with_leftover
from warmprior.modules.sampler import PriorSampler
from warmprior.modules.step import StepPrior
from warmprior.modules.trend import PoseTrend, RestingAction
from warmprior.modules.vision import VisionNetwork

__all__ = [
    "A2APrior",
    "CVAEPrior",
    "ChiTransformer",
    "ForecastPrior",
    "GaussianPrior",
    "HistoryPrior",
    "ImageEncoder",
    "Interpolant",
    "LeapPrior",
    "LearnedPrior",
    "LearningWindows",
    "LinearInterpolant",
    "Normalizer",
    "ODEActor",
    "OTPrior",
    "PastPrior",
    "PolynomialInterpolant",
    "PoseTrend",
    "PreconditionedNetwork",
    "PreviewPrior",
    "Prior",
    "PriorSampler",
    "RealTimeChunking",
    "ReflowPrior",
    "RegressionPrior",
    "RestingAction",
    "SourceMoments",
    "StepPrior",
    "TimestepEmbedding",
    "TrigonometricInterpolant",
    "VelocityMLP",
    "VelocityNetwork",
    "VisionNetwork",
    "WarmPriorActor",
    "imagenet_weights",
    "integrate",
    "load_imagenet",
    "with_leftover",
]
