# SPDX-License-Identifier: Apache-2.0

"""skin.launch.py under launch_testing: a skin, and a body, to their first frames and a clean end.

    launch_test test/launch/skin.test.py        # once the workspace is built and sourced

test/ros/test_launch.py runs this, too, where launch_testing is installed.
"""

import time
import unittest
from pathlib import Path
from typing import Any

import launch_testing
import launch_testing.actions
import launch_testing.asserts
import rclpy
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from tactile_cdma.msg import TactileArray, TactileContacts

ROOT = Path(__file__).resolve().parents[2]
ARGUMENTS = (
    {"sim": "true", "namespace": "alone"},
    {"patches": str(ROOT / "config" / "body.yaml"), "only": "left_palm,right_elbow"},
)
PATIENCE_S = 30.0


@launch_testing.parametrize("arguments", ARGUMENTS)
def generate_test_description(arguments: dict[str, str]) -> LaunchDescription:
    """Include the launch file as a user's would."""
    source = PythonLaunchDescriptionSource(str(ROOT / "launch" / "skin.launch.py"))
    skin = IncludeLaunchDescription(source, launch_arguments=arguments.items())
    return LaunchDescription([skin, launch_testing.actions.ReadyToTest()])


class WhileItRuns(unittest.TestCase):
    """What comes from the nodes that were launched."""

    def setUp(self) -> None:
        """Listen."""
        rclpy.init()
        self.node = Node("listener")

    def tearDown(self) -> None:
        """Stop listening."""
        self.node.destroy_node()
        rclpy.shutdown()

    def test_frames_come(self, arguments: dict[str, str]) -> None:
        """Each driver's, with as many taxels as its skin has."""
        taxels = {"left_palm": 16, "right_elbow": 25} if "only" in arguments else {"alone": 16}
        arrays: dict[str, list[TactileArray]] = {patch: [] for patch in taxels}
        for patch, received in arrays.items():
            topic = f"/{patch}/skin/tactile"
            self.node.create_subscription(
                TactileArray, topic, received.append, qos_profile_sensor_data
            )
        self.wait_for(lambda: all(len(received) > 5 for received in arrays.values()))
        sizes = {patch: len(received[-1].pressure) for patch, received in arrays.items()}
        self.assertEqual(sizes, taxels)

    def test_the_body_knows_who_was_left_out(self, arguments: dict[str, str]) -> None:
        """The patches of the file that `only` does not name."""
        if "patches" not in arguments:
            self.skipTest("one skin has no body")
        bodies: list[TactileContacts] = []
        self.node.create_subscription(TactileContacts, "/body/contacts", bodies.append, 10)
        others = ["/chest/skin", "/left_forearm/skin", "/right_forearm/skin"]
        self.wait_for(lambda: bodies and bodies[-1].absent == others)

    def wait_for(self, condition: Any) -> None:
        """Spin until it holds."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            self.assertLess(time.monotonic(), deadline, "waited in vain")
            rclpy.spin_once(self.node, timeout_sec=0.1)


@launch_testing.post_shutdown_test()
class AfterTheEnd(unittest.TestCase):
    """How the processes ended."""

    def test_all_ended_in_order(self, proc_info: Any) -> None:
        """With exit code 0."""
        launch_testing.asserts.assertExitCodes(proc_info)
