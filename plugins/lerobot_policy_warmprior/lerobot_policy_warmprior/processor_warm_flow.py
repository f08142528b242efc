"""Processors of warm_flow: LeRobot's own normalisation of states and actions."""

from lerobot.processor import (
    make_default_pre_post_processors as make_warm_flow_pre_post_processors,
)

__all__ = ["make_warm_flow_pre_post_processors"]
