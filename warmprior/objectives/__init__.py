"""Losses, and how they pair sources with targets."""

from warmprior.objectives.couplings import BridgeCoupling, Coupling, OTCoupling, ReflowCoupling
from warmprior.objectives.flow_matching import FlowMatchingLoss

__all__ = ["BridgeCoupling", "Coupling", "FlowMatchingLoss", "OTCoupling", "ReflowCoupling"]
