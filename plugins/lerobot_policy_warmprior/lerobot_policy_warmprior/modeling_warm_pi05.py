"""``--policy.type=warm_pi05``."""

from lerobot.policies.pi05.modeling_pi05 import PI05Policy

from lerobot_policy_warmprior.configuration_warm_pi05 import WarmPI05Config
from lerobot_policy_warmprior.warm import WarmPolicyMixin

__all__ = ["WarmPI05Policy"]


class WarmPI05Policy(WarmPolicyMixin, PI05Policy):
    """PI05 whose chunks start from a prior; its checkpoints load unchanged."""

    config_class = WarmPI05Config
    name = "warm_pi05"
