"""Options of ``--policy.type=warm_smolvla``."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig

from lerobot_policy_warmprior.warm import WarmConfigMixin

__all__ = ["WarmSmolVLAConfig"]


@PreTrainedConfig.register_subclass("warm_smolvla")
@dataclass
class WarmSmolVLAConfig(WarmConfigMixin, SmolVLAConfig):
    """SmolVLA's options and those of the source."""
