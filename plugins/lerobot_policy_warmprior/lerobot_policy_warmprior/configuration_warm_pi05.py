"""Options of ``--policy.type=warm_pi05``."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config

from lerobot_policy_warmprior.warm import WarmConfigMixin

__all__ = ["WarmPI05Config"]


@PreTrainedConfig.register_subclass("warm_pi05")
@dataclass
class WarmPI05Config(WarmConfigMixin, PI05Config):
    """PI05's options and those of the source."""
