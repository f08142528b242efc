"""Processors of the warm VLAs: the policies' own, in whose units the source is."""

from lerobot.policies.pi05.processor_pi05 import (
    make_pi05_pre_post_processors as make_warm_pi05_pre_post_processors,
)
from lerobot.policies.smolvla.processor_smolvla import (
    make_smolvla_pre_post_processors as make_warm_smolvla_pre_post_processors,
)

__all__ = ["make_warm_pi05_pre_post_processors", "make_warm_smolvla_pre_post_processors"]
