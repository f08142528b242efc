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

    @property
    def drop_n_last_frames(self) -> int:
        """Return the number of an episode's last steps, which begin no whole chunk, that GR00T leaves out."""
        # GR00T counts the steps of every window, and these include the remembered ones.
        return super().drop_n_last_frames - self.make_prior().history_length
