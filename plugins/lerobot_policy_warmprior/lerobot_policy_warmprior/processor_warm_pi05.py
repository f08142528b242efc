"""PI05's own processors: the source is in the units that they make."""

from lerobot.policies.pi05.processor_pi05 import (
    make_pi05_pre_post_processors as make_warm_pi05_pre_post_processors,
)

__all__ = ["make_warm_pi05_pre_post_processors"]
