# SPDX-License-Identifier: Apache-2.0

"""An arm of two joints and a camera, and a hand that leads it; neither is real.

The arm is where it was sent to last, and notes that in a file, a line of JSON each. The hand's
joints go round in circles.
"""

import json
import math
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINTS = ("lift.pos", "close.pos")
PIXELS = (64, 64, 3)


@RobotConfig.register_subclass("tried_arm")
@dataclass
class TriedArmConfig(RobotConfig):
    """log: file of the actions that were sent."""

    log: str = ""


@TeleoperatorConfig.register_subclass("tried_hand")
@dataclass
class TriedHandConfig(TeleoperatorConfig):
    """A hand without options."""


class _Device:
    """What LeRobot asks of every device."""

    is_connected = False
    is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None:
        """There is nothing to calibrate."""

    def configure(self) -> None:
        """There is nothing to configure."""

    def disconnect(self) -> None:
        self.is_connected = False


class TriedArm(_Device, Robot):
    """Two joints and a camera."""

    config_class = TriedArmConfig
    name = "tried_arm"

    def __init__(self, config: TriedArmConfig) -> None:
        super().__init__(config)
        self.at = dict.fromkeys(JOINTS, 0.0)
        self.log = Path(config.log)
        self.cameras: dict[str, Any] = {}

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(JOINTS, float), "front": PIXELS}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    def get_observation(self) -> dict[str, Any]:
        shade = round(127 * (1 + math.sin(self.at[JOINTS[0]])))
        return {**self.at, "front": np.full(PIXELS, shade, np.uint8)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.at = {name: float(action[name]) for name in JOINTS}
        with self.log.open("a") as log:
            log.write(json.dumps(list(self.at.values())) + "\n")
        return action


class TriedHand(_Device, Teleoperator):
    """Leads the arm in circles."""

    config_class = TriedHandConfig
    name = "tried_hand"

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    @cached_property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    def get_action(self) -> dict[str, Any]:
        now_s = time.monotonic()
        return dict(zip(JOINTS, (math.sin(now_s), math.cos(now_s)), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """It feels nothing."""
