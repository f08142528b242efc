"""Losses, and how they pair sources with targets."""

from warmprior.objectives.couplings import Coupling, OTCoupling, ReflowCoupling
from warmprior.objectives.flow_matching import FlowMatchingLoss
from warmprior.objectives.self_distillation import SelfDistillationLoss

__all__ = [
    "Coupling",
    "FlowMatchingLoss",
    "OTCoupling",
    "ReflowCoupling",
    "SelfDistillationLoss",
]
