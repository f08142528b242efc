"""A simulated arm with a camera, and its leader, as a package that LeRobot finds by its name."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINTS = ("shoulder.pos", "elbow.pos")


class Device:
    """A device without hardware, from which arm and leader inherit."""

    action_features = dict.fromkeys(JOINTS, float)
    is_calibrated, is_connected = True, False

    def connect(self, calibrate=True):
        self.is_connected = True

    def calibrate(self): ...

    def configure(self): ...

    def disconnect(self):
        self.is_connected = False


@RobotConfig.register_subclass("sim_arm")
@dataclass(kw_only=True)
class SimArmConfig(RobotConfig):
    """Where the arm writes the actions that it was sent, if anywhere."""

    log: str = ""


class SimArm(Device, Robot):
    """Two joints that go half of the way to their targets at every step."""

    config_class, name = SimArmConfig, "sim_arm"
    cameras = {"front": None}  # noqa: RUF012
    observation_features = {**dict.fromkeys(JOINTS, float), "front": (48, 64, 3)}  # noqa: RUF012

    def __init__(self, config):
        super().__init__(config)
        self.config, self.joints, self.sent = config, dict.fromkeys(JOINTS, 0.0), []

    def get_observation(self):
        image = np.zeros((48, 64, 3), np.uint8)
        image[:, : int(32 * (1 + self.joints[JOINTS[0]])) % 64] = 200
        return {**self.joints, "front": image}

    def send_action(self, action):
        self.sent.append([action[name] for name in JOINTS])
        self.joints = {name: (self.joints[name] + action[name]) / 2 for name in JOINTS}
        return action

    def disconnect(self):
        super().disconnect()
        if self.config.log:
            Path(self.config.log).write_text(json.dumps(self.sent))


@TeleoperatorConfig.register_subclass("sim_leader")
@dataclass
class SimLeaderConfig(TeleoperatorConfig):
    """Without options."""


class SimLeader(Device, Teleoperator):
    """Moves both joints to and fro."""

    config_class, name = SimLeaderConfig, "sim_leader"
    feedback_features = {}  # noqa: RUF012

    def get_action(self):
        return {name: 0.5 * math.sin(3 * time.monotonic() + k) for k, name in enumerate(JOINTS)}

    def send_feedback(self, feedback): ...
