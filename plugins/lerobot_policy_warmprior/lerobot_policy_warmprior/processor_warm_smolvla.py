"""SmolVLA's own processors: the source is in the units that they make."""

from lerobot.policies.smolvla.processor_smolvla import (
    make_smolvla_pre_post_processors as make_warm_smolvla_pre_post_processors,
)

__all__ = ["make_warm_smolvla_pre_post_processors"]
