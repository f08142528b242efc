"""WarmPrior for the flow policies of LeRobot, without changing them."""

from warmprior.lerobot.actor import LeRobotActor, LeRobotFlow
from warmprior.lerobot.adapter import WarmPriorAdapter, history_indices
from warmprior.lerobot.memory import ActionMemory
from warmprior.lerobot.ports import PORTS, FlowPort, port_for
from warmprior.lerobot.relative import RelativeActions
from warmprior.lerobot.source import ChunkSource, action_std

__all__ = [
    "PORTS",
    "ActionMemory",
    "ChunkSource",
    "FlowPort",
    "LeRobotActor",
    "LeRobotFlow",
    "RelativeActions",
    "WarmPriorAdapter",
    "action_std",
    "history_indices",
    "port_for",
]
