# SPDX-License-Identifier: Apache-2.0

"""The node of a whole body: contacts, taxels, points and names of its patches in one tf frame.

It subscribes only to what its own subscribers need.
"""

import sys
import time
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from ...base.program import program
from ..common.convert import report
from ..common.nodes import STEADY, TAKEN, all_or_nothing, changing
from ..common.process import run_node
from ..common.qos import offered
from .outputs import ContactsOutput, PointsOutput, TaxelsOutput
from .parameters import body_setup, declared
from .patches import Patches
from .report import body_report

NODE_NAME = "body"
TICK_S = 0.2
"""Interval of looks at who subscribes, and of names, s; chosen."""
REPORT_S = 1.0
"""Interval of /diagnostics, s, as usual in ROS."""


class BodyNode(Node):
    """Combines what the drivers of a body's patches publish."""

    @all_or_nothing
    def __init__(self, **node_options: Any) -> None:
        """Raises TactileError for wrong parameters."""
        super().__init__(NODE_NAME, **node_options)
        self.patches = Patches(self, *body_setup(self))
        kinds = ContactsOutput, TaxelsOutput, PointsOutput
        self.outputs = [kind(self.patches, self._offer) for kind in kinds]
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._watch = self.get_clock().create_jump_callback(back, post_callback=self._step_back)
        self.create_timer(TICK_S, self._tick, clock=STEADY)
        self.create_timer(REPORT_S, self._report, clock=STEADY)

    def set_parameters_atomically(self, changes: list[Parameter]) -> SetParametersResult:
        """Take what changes nothing; all else is read when the node starts."""
        changes = changing(self, changes)
        return super().set_parameters_atomically(changes) if changes else TAKEN

    def _offer(self, kind: Any, topic: str, qos: QoSProfile) -> Publisher:
        return self.create_publisher(
            kind, topic, offered(qos, self, topic, partial(declared, self))
        )

    def _tick(self) -> None:
        """Follow what is asked for; publish that patches are absent where nothing comes."""
        asked = [output.tick() for output in self.outputs]
        self.patches.follow_transforms(any(asked))

    def _step_back(self, _: TimeJump) -> None:
        for arrivals in self.patches.arrivals.values():
            arrivals.step_back()

    def _report(self) -> None:
        is_followed = any(output.following for output in self.outputs)
        name = self.get_fully_qualified_name()
        entries = body_report(name, self.patches, is_followed, time.monotonic())
        self._diagnostics.publish(report(self, entries))


@program("skin_body")
def main() -> int:
    """Run the node until interrupted; returns the exit code."""
    return run_node(BodyNode)


if __name__ == "__main__":
    sys.exit(main())
