"""Losses."""

from warmprior.objectives.dsrl import DSRLNALoss
from warmprior.objectives.flow_matching import FlowMatchingLoss

__all__ = ["DSRLNALoss", "FlowMatchingLoss"]
