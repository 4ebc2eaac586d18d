# SPDX-License-Identifier: Apache-2.0

"""The options of lerobot-record for a robot with skins."""

from dataclasses import dataclass, field
from typing import Any

import draccus
from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("tactile_cdma")
@dataclass(kw_only=True)
class TactileRobotConfig(RobotConfig):
    """A robot with skins.

    robot: options of the robot itself, with its type, as a mapping: as a RobotConfig its own
    options would be asked for without end. skin: parameter file of the driver of one skin, with its
    port; or body: body file of many. contacts: contacts and wrenches, too.
    """

    robot: dict[str, Any] = field(default_factory=dict)
    skin: str = ""
    body: str = ""
    contacts: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.skin) == bool(self.body):
            raise ValueError("give --robot.skin=FILE.yaml, or --robot.body=FILE.yaml")
        if "type" not in self.robot:
            raise ValueError("give the robot itself: --robot.robot='{type: so101_follower, …}'")

    @property
    def itself(self) -> RobotConfig:
        """The configuration of the robot without skins."""
        config: RobotConfig = draccus.decode(RobotConfig, self.robot)
        return config
