"""Normalisation of states and actions by LeRobot's own steps, between raw units and those of the policy."""

from lerobot.processor import (
    make_default_pre_post_processors as make_warm_flow_pre_post_processors,
)

__all__ = ["make_warm_flow_pre_post_processors"]
