"""``--policy.type=warm_smolvla``."""

from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

from lerobot_policy_warmprior.configuration_warm_smolvla import WarmSmolVLAConfig
from lerobot_policy_warmprior.warm import WarmPolicyMixin

__all__ = ["WarmSmolVLAPolicy"]


class WarmSmolVLAPolicy(WarmPolicyMixin, SmolVLAPolicy):
    """SmolVLA whose chunks start from a prior; its checkpoints load unchanged."""

    config_class = WarmSmolVLAConfig
    name = "warm_smolvla"
