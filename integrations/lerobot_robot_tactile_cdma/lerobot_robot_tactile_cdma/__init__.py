# SPDX-License-Identifier: Apache-2.0

"""A robot of LeRobot with skins: `--robot.type=tactile_cdma`; docs/learning.md has how to use it.

LeRobot imports this package when its commands start, because of its name, and looks here for the
class whose name is that of the configuration without "Config".
"""

from .config import TactileRobotConfig
from .robot import TactileRobot
from .touch import touch_of

__all__ = ["TactileRobot", "TactileRobotConfig", "touch_of"]
