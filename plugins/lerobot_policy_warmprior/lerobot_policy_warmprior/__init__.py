"""WarmPrior's policies for LeRobot, which finds this package by its name and the policies by their types."""

from lerobot_policy_warmprior.configuration_warm_flow import WarmFlowConfig
from lerobot_policy_warmprior.configuration_warm_groot import WarmGrootConfig
from lerobot_policy_warmprior.configuration_warm_vla import WarmPI05Config, WarmSmolVLAConfig
from lerobot_policy_warmprior.robosuite_env import RobosuiteEnvConfig

__all__ = ["RobosuiteEnvConfig", "WarmFlowConfig", "WarmGrootConfig", "WarmPI05Config", "WarmSmolVLAConfig"]
