"""The loss, and how it pairs sources with targets."""

from warmprior.objectives.couplings import Coupling, OTCoupling, ReflowCoupling
from warmprior.objectives.flow_matching import FlowMatchingLoss

__all__ = [
    "Coupling",
    "FlowMatchingLoss",
    "OTCoupling",
    "ReflowCoupling",
]
