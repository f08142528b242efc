"""GR00T N1.7 with the source of a prior."""

from __future__ import annotations

from lerobot.policies.groot.modeling_groot import GrootPolicy

from lerobot_policy_warmprior.configuration_warm_groot import WarmGrootConfig
from lerobot_policy_warmprior.modeling_warm_vla import WarmPolicyMixin


class WarmGrootPolicy(WarmPolicyMixin, GrootPolicy):
    """GR00T N1.7 whose chunks start from a prior; its checkpoints load unchanged."""

    config_class = WarmGrootConfig
    name = "warm_groot"
