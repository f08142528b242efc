"""GR00T N1.7 with the source of a prior."""

from __future__ import annotations

from typing import Any

from lerobot.policies.groot.modeling_groot import GrootPolicy

from lerobot_policy_warmprior.configuration_warm_groot import WarmGrootConfig
from lerobot_policy_warmprior.modeling_warm_vla import WarmPolicyMixin
from lerobot_policy_warmprior.processor_warm_groot import check_pretrained


class WarmGrootPolicy(WarmPolicyMixin, GrootPolicy):
    """GR00T N1.7 whose chunks start from a prior; ``base_model_path`` names a checkpoint of GR00T."""

    config_class = WarmGrootConfig
    name = "warm_groot"

    def __init__(self, config: WarmGrootConfig, *args: Any, **kwargs: Any) -> None:
        if config.pretrained_path:
            check_pretrained(config)
        super().__init__(config, *args, **kwargs)
