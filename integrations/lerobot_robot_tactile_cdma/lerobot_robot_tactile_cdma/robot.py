# SPDX-License-Identifier: Apache-2.0

"""TactileRobot: another robot, whose observations have the taxels of its skins besides."""

from functools import cached_property
from typing import Any

from lerobot.robots import Robot, make_robot_from_config

from .config import TactileRobotConfig
from .touch import Touch


class TactileRobot(Robot):
    """Passes everything on to its robot; touch: its skins."""

    config_class = TactileRobotConfig
    name = "tactile_cdma"

    def __init__(self, config: TactileRobotConfig) -> None:
        super().__init__(config)
        self.robot = make_robot_from_config(config.itself)
        self.cameras = getattr(self.robot, "cameras", {})
        self.touch = Touch(config.skin, config.body, config.contacts)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        return {**self.robot.observation_features, **dict.fromkeys(self.touch.names, float)}

    @property
    def action_features(self) -> dict[str, Any]:
        return self.robot.action_features

    @property
    def is_connected(self) -> bool:
        return self.robot.is_connected and self.touch.is_open

    @property
    def is_calibrated(self) -> bool:
        return self.robot.is_calibrated

    def connect(self, calibrate: bool = True) -> None:
        """Connect robot and skins; raises what they raise, and then neither is connected."""
        self.robot.connect(calibrate)
        try:
            self.touch.open()
        except BaseException:
            self.robot.disconnect()
            raise

    def calibrate(self) -> None:
        self.robot.calibrate()

    def configure(self) -> None:
        self.robot.configure()

    def get_observation(self) -> dict[str, Any]:
        return {**self.robot.get_observation(), **self.touch.read()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return self.robot.send_action(action)

    def disconnect(self) -> None:
        try:
            self.touch.close()
        finally:
            self.robot.disconnect()
