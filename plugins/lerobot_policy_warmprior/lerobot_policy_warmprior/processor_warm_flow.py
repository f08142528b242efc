"""Normalisation of states and actions by LeRobot's own steps."""

from __future__ import annotations

from typing import Any

from lerobot.processor import make_default_pre_post_processors

__all__ = ["make_warm_flow_pre_post_processors"]


def make_warm_flow_pre_post_processors(config: Any, dataset_stats: Any = None) -> tuple[Any, Any]:
    """Between raw units and those of the policy.

    Args:
        config: the policy's.
        dataset_stats: of the dataset, ``dataset.meta.stats``.
    """
    return make_default_pre_post_processors(config, dataset_stats)
