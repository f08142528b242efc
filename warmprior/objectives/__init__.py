"""Losses."""

from warmprior.objectives.flow_matching import FlowMatchingLoss

__all__ = ["FlowMatchingLoss"]
