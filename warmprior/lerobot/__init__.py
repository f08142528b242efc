"""WarmPrior for the flow policies of LeRobot, without changing them."""

from warmprior.lerobot.actor import LeRobotActor
from warmprior.lerobot.adapter import RelativeActions, WarmPriorAdapter, history_indices
from warmprior.lerobot.ports import PORTS, FlowPort
from warmprior.lerobot.source import action_std

__all__ = [
    "PORTS",
    "FlowPort",
    "LeRobotActor",
    "RelativeActions",
    "WarmPriorAdapter",
    "action_std",
    "history_indices",
]
