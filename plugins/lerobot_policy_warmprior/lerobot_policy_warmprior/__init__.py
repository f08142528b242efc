"""LeRobot finds this package by its name, and these policies by their types."""

from lerobot_policy_warmprior.configuration_warm_flow import WarmFlowConfig
from lerobot_policy_warmprior.configuration_warm_pi05 import WarmPI05Config
from lerobot_policy_warmprior.configuration_warm_smolvla import WarmSmolVLAConfig
from lerobot_policy_warmprior.robosuite_config import RobosuiteEnvConfig

__all__ = ["RobosuiteEnvConfig", "WarmFlowConfig", "WarmPI05Config", "WarmSmolVLAConfig"]
