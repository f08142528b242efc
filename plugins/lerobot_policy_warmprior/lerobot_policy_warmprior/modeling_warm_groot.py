"""GR00T N1.7 with the source of a prior."""

from __future__ import annotations

from typing import Any, Self

from lerobot.policies.groot.modeling_groot import GrootPolicy

from lerobot_policy_warmprior.configuration_warm_groot import WarmGrootConfig
from lerobot_policy_warmprior.loading import HUB
from lerobot_policy_warmprior.modeling_warm_vla import WarmPolicyMixin
from lerobot_policy_warmprior.processor_warm_groot import check_pretrained


class WarmGrootPolicy(WarmPolicyMixin, GrootPolicy):
    """GR00T N1.7 whose chunks start from a prior; ``base_model_path`` names a checkpoint of GR00T."""

    config_class = WarmGrootConfig
    name = "warm_groot"

    def __init__(self, config: Any, **kwargs: Any) -> None:
        # Saved, because the default depends on files below base_model_path that a robot may not have.
        config.prior_chunk = config.make_prior().chunk_length
        super().__init__(config, **kwargs)

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: Any, *, config: Any = None, revision: str | None = None, **kwargs: Any
    ) -> Self:
        """Load a saved policy; a ``ValueError`` if a run that continues its training has another history."""
        if config is not None and config.pretrained_path:  # LeRobot takes the processors as well
            hub = {name: kwargs[name] for name in HUB if name in kwargs}
            check_pretrained(config, str(pretrained_name_or_path), revision=revision, **hub)
        return super().from_pretrained(pretrained_name_or_path, config=config, revision=revision, **kwargs)
