"""Options of ``--policy.type=warm_groot``, GR00T N1.7 with the source of a prior."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.groot.configuration_groot import GrootConfig

from lerobot_policy_warmprior.configuration_warm_vla import WarmConfigMixin


@PreTrainedConfig.register_subclass("warm_groot")
@dataclass
class WarmGrootConfig(WarmConfigMixin, GrootConfig):
    """GR00T's options, and those of the source."""
