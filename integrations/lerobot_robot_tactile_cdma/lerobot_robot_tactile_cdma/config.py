# SPDX-License-Identifier: Apache-2.0

"""The options of lerobot-record for a robot with skins."""

from dataclasses import dataclass

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("tactile_cdma")
@dataclass(kw_only=True)
class TactileRobotConfig(RobotConfig):
    """A robot with skins.

    robot: the robot itself, as it would be without. skin: parameter file of the driver of one skin,
    with its port; or body: body file of many. contacts: contacts and wrenches, too.
    """

    robot: RobotConfig
    skin: str = ""
    body: str = ""
    contacts: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.skin) == bool(self.body):
            raise ValueError("give --robot.skin=FILE.yaml, or --robot.body=FILE.yaml")
