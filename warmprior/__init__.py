"""WarmPrior: temporally grounded source distributions for flow-matching policies, in TorchRL.

The public names of :mod:`warmprior.modules`, :mod:`warmprior.transforms`,
:mod:`warmprior.objectives` and :mod:`warmprior.rl` are available here. :mod:`warmprior.data`,
:mod:`warmprior.envs`, :mod:`warmprior.training` and :mod:`warmprior.diagnostics` are imported by
name; parts of them need the extra ``warmprior[sim]``.
"""

from importlib.metadata import version

from warmprior.modules import (
    ChiTransformer,
    GaussianPrior,
    HistoryPrior,
    Interpolant,
    LinearInterpolant,
    Normalizer,
    ODEActor,
    PastPrior,
    PolynomialInterpolant,
    PoseTrend,
    PreconditionedNetwork,
    PreviewPrior,
    Prior,
    PriorSampler,
    RegressionPrior,
    RestingAction,
    SourceMoments,
    TrigonometricInterpolant,
    VelocityMLP,
    VelocityNetwork,
    WarmPriorActor,
    integrate,
)
from warmprior.objectives import FlowMatchingLoss
from warmprior.rl import (
    BoxTanhNormal,
    DSRLNALoss,
    PriorAnchor,
    PriorDecoder,
    PriorSpace,
    ResidualSampler,
    make_prior_space_actor,
    make_prior_space_critic,
)
from warmprior.transforms import (
    AbsoluteActions,
    ActionHistory,
    ActionWindow,
    ChunkStep,
    MeanObservation,
    ObservationStack,
    policy_transforms,
    window_replay_buffer,
    window_transforms,
)

__version__ = version("warmprior")

__all__ = [
    "AbsoluteActions",
    "ActionHistory",
    "ActionWindow",
    "BoxTanhNormal",
    "ChiTransformer",
    "ChunkStep",
    "DSRLNALoss",
    "FlowMatchingLoss",
    "GaussianPrior",
    "HistoryPrior",
    "Interpolant",
    "LinearInterpolant",
    "MeanObservation",
    "Normalizer",
    "ODEActor",
    "ObservationStack",
    "PastPrior",
    "PolynomialInterpolant",
    "PoseTrend",
    "PreconditionedNetwork",
    "PreviewPrior",
    "Prior",
    "PriorAnchor",
    "PriorDecoder",
    "PriorSampler",
    "PriorSpace",
    "RegressionPrior",
    "ResidualSampler",
    "RestingAction",
    "SourceMoments",
    "TrigonometricInterpolant",
    "VelocityMLP",
    "VelocityNetwork",
    "WarmPriorActor",
    "__version__",
    "integrate",
    "make_prior_space_actor",
    "make_prior_space_critic",
    "policy_transforms",
    "window_replay_buffer",
    "window_transforms",
]
