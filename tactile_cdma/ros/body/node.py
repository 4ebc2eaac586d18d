# SPDX-License-Identifier: Apache-2.0

"""The node of a whole body: contacts, taxels, points and names of its patches in one tf frame.

It subscribes only to what its own subscribers need.
"""

import sys
import time
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from tactile_cdma.msg import TactileBody, TactileContacts

from ...base.errors import TransformError
from ...messages.cdr import Heading, TaxelArray
from ...messages.rounds import Rounds
from ...places.poses import Pose
from ...views.cloud import BODY_POINT
from ..common.convert import UNKNOWN_WRENCH, is_known, point_cloud, report, wrench_stamped
from ..common.nodes import STEADY, TAKEN, all_or_nothing, changing
from ..common.process import run_node
from ..common.qos import PICTURE, RELIABLE, offered
from ..common.touches import Touches
from ..common.transforms import TransformListener
from .contacts import body_contacts
from .names import body_names
from .parameters import body_setup, declared
from .patch_feed import PatchFeed
from .report import body_report
from .tactile import Part, body_tactile

NODE_NAME = "body"
TICK_S = 0.2
"""Interval of looks at who subscribes, and of names, s; chosen."""
FIRST_S = 2.0
"""Longest wait for all patches before the first message, s, unless stale_after_s is longer. A patch
that was not heard yet is not absent. Chosen: on a busy computer discovery takes a second."""
REPORT_S = 1.0
"""Interval of /diagnostics, s, as usual in ROS."""


class BodyNode(Node):
    """Combines what the drivers of a body's patches publish."""

    @all_or_nothing
    def __init__(self, **node_options: Any) -> None:
        """Raises TactileError for wrong parameters."""
        super().__init__(NODE_NAME, **node_options)
        patches, self._values = body_setup(self)
        self._contacts = self._publisher(TactileContacts, "~/contacts", RELIABLE)
        self._wrench = self._publisher(WrenchStamped, "~/wrench", RELIABLE)
        self._tactile = self._publisher(TactileBody, "~/tactile", qos_profile_sensor_data)
        self._points = self._publisher(PointCloud2, "~/points", PICTURE)
        self._names = self._publisher(MarkerArray, "~/names", PICTURE)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._feeds = {
            name: PatchFeed(self, name, index, self._take_contacts, self._take_taxels)
            for index, name in enumerate(patches)
        }
        self._transforms = TransformListener(self)
        self._faults: dict[str, str] = {}  # why a patch's frame is not known in the body's
        self._rounds = Rounds(self._values["stale_after_s"])
        self._published_s = time.monotonic()  # when contacts were, or would have been, published
        self._is_first = True  # nobody has had a message yet
        self._sequence = 0
        self._taxel_rounds = Rounds(self._values["stale_after_s"])
        self._taxels_s, self._taxels_sequence = time.monotonic(), 0
        self._drawn: list[PatchFeed] = []  # patches that the last points are of
        self._are_points_due = False
        self._cloud = b""
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        self._watch = self.get_clock().create_jump_callback(back, post_callback=self._step_back)
        self.create_timer(TICK_S, self._tick, clock=STEADY)
        self.create_timer(REPORT_S, self._report, clock=STEADY)
        self._points_timer = self.create_timer(
            1.0 / self._values["visual_rate_hz"], self._ask_for_points, clock=STEADY
        )
        self._points_timer.cancel()  # until somebody asks

    def _publisher(self, kind: Any, topic: str, qos: QoSProfile) -> Publisher:
        return self.create_publisher(
            kind, topic, offered(qos, self, topic, partial(declared, self))
        )

    def _tick(self) -> None:
        """Follow what is asked for; publish that patches are absent where nothing comes."""
        topics = self._contacts, self._wrench, self._points, self._names, self._tactile
        asked = [bool(topic.get_subscription_count()) for topic in topics]
        contacts, (points, names, taxels) = asked[0] or asked[1], asked[2:]
        for feed in self._feeds.values():
            feed.follow(contacts, points or names, taxels)
        self._transforms.follow(contacts or points or names or taxels)
        if points:
            if self._points_timer.is_canceled():
                self._points_timer.reset()
            self._look_at_points()  # notices silent patches, however seldom points are drawn
        else:
            self._points_timer.cancel()
        if names:
            self._publish_names()
        now_s = time.monotonic()
        if not taxels:
            self._taxel_rounds.forget()
            self._taxels_s = now_s
        elif now_s - self._taxels_s > self._values["stale_after_s"]:
            self._publish_taxels(now_s)
        if not contacts:
            self._rounds.forget()
            self._published_s, self._is_first = now_s, True
        elif now_s - self._published_s > self._values["stale_after_s"]:
            self._publish_contacts(now_s)

    def _pose(self, feed: PatchFeed, message: Touches | TaxelArray | None) -> Pose | None:
        """The pose in the body's frame of what a patch sent; None, noting the fault, if unknown."""
        if message is None:
            return None
        try:
            pose = self._transforms.tree.pose(self._values["frame_id"], message.heading.frame_id)
        except TransformError as error:
            self._faults[feed.node_name] = str(error)
            return None
        self._faults.pop(feed.node_name, None)
        return pose

    def set_parameters_atomically(self, changes: list[Parameter]) -> SetParametersResult:
        """Take what changes nothing; all else is read when the node starts."""
        changes = changing(self, changes)
        return super().set_parameters_atomically(changes) if changes else TAKEN

    def _step_back(self, _: TimeJump) -> None:
        for feed in self._feeds.values():
            feed.step_back()

    # Contacts and wrench

    def _take_contacts(self, feed: PatchFeed, message: Touches) -> None:
        now_s = time.monotonic()
        if self._rounds.is_due_before(feed.node_name):
            self._publish_contacts(now_s)
        feed.contacts = message
        if self._rounds.add(feed.node_name, now_s):
            self._publish_contacts(now_s)

    def _publish_contacts(self, now_s: float) -> None:
        self._rounds.end()
        parts: list[tuple[Pose, Touches]] = []
        absent = []
        present = set(self._rounds.present(self._feeds, now_s))
        for name, feed in self._feeds.items():
            latest = feed.contacts if name in present else None
            pose = self._pose(feed, latest)
            if latest and pose and latest.taxels_valid:
                parts.append((pose, latest))
            else:
                absent.append(name)
        patience_s = max(FIRST_S, self._values["stale_after_s"])
        if absent and self._is_first and now_s - self._published_s <= patience_s:
            return
        self._published_s, self._is_first = now_s, False
        heading = self._heading([message.heading.stamp_ns for _, message in parts])
        found = body_contacts(parts, absent, heading, self._sequence)
        self._sequence += 1
        self._contacts.publish(found.message)
        if self._wrench.get_subscription_count() and (
            self._values[UNKNOWN_WRENCH] or is_known(found.force_n, found.torque_nm)
        ):
            self._wrench.publish(wrench_stamped(heading, found.force_n, found.torque_nm))

    def _heading(self, stamps_ns: list[int]) -> Heading:
        """A heading with the newest stamp; with the present time if there is none."""
        newest_ns = max(stamps_ns) if stamps_ns else self.get_clock().now().nanoseconds
        return Heading(newest_ns, self._values["frame_id"])

    # Taxels

    def _take_taxels(self, feed: PatchFeed, message: TaxelArray) -> None:
        now_s = time.monotonic()
        if self._taxel_rounds.is_due_before(feed.node_name):
            self._publish_taxels(now_s)
        feed.taxels = message
        if self._taxel_rounds.add(feed.node_name, now_s):
            self._publish_taxels(now_s)

    def _publish_taxels(self, now_s: float) -> None:
        self._taxel_rounds.end()
        self._taxels_s = now_s
        parts, absent, stamps_ns = [], [], []
        present = set(self._taxel_rounds.present(self._feeds, now_s))
        for name, feed in self._feeds.items():
            array, places = feed.taxels, feed.places
            pose = self._pose(feed, array)
            is_absent = name not in present or places is None
            if array and places:
                is_absent |= array.info_id != places.info_id or len(array.status) != len(places)
                parts.append(Part(name, array, places, pose, is_absent))
            if is_absent:
                absent.append(name)
            elif array:
                stamps_ns.append(array.heading.stamp_ns)
        self._tactile.publish(
            body_tactile(parts, absent, self._heading(stamps_ns), self._taxels_sequence)
        )
        self._taxels_sequence += 1

    # Points

    def _ask_for_points(self) -> None:
        self._are_points_due = True
        self._look_at_points()

    def _look_at_points(self) -> None:
        """If due, publish the latest of every patch if any is new, or a patch has come or gone."""
        for feed in self._feeds.values():
            feed.poll_points()
        now_s, stamps_ns, clouds = time.monotonic(), [], []
        present = [
            feed
            for feed in self._feeds.values()
            if feed.silent_s(now_s) <= self._values["stale_after_s"]
        ]
        is_new = any(feed.is_new for feed in present) or present != self._drawn
        if not self._are_points_due or not is_new:
            return
        self._are_points_due, self._drawn = False, present
        for feed in present:
            feed.is_new = False
            pose = self._pose(feed, feed.array)
            max_pa, gamma = self._values["colour_max_kpa"] * 1e3, self._values["colour_gamma"]
            cloud = feed.points(max_pa, pose, gamma) if pose else None
            if feed.array and cloud is not None:
                stamps_ns.append(feed.array.heading.stamp_ns)
                clouds.append(cloud)
        # Kept until the next one, as by the driver's Pictures.
        self._cloud = point_cloud(BODY_POINT, clouds, self._heading(stamps_ns))
        self._points.publish(self._cloud)

    # Names

    def _publish_names(self) -> None:
        """Of all patches that were heard; one that has fallen silent is missed there."""
        places_m = {}
        for feed in self._feeds.values():
            feed.poll_points()
            pose = self._pose(feed, feed.array)
            if pose and (taxels_m := feed.taxels_m) is not None:
                places_m[feed.node_name] = pose.apply(taxels_m)
        if places_m:
            self._names.publish(body_names(places_m, self._values["frame_id"]))

    # Diagnostics

    def _report(self) -> None:
        name, stale_after_s = self.get_fully_qualified_name(), self._values["stale_after_s"]
        entries = body_report(name, self._feeds, self._faults, stale_after_s, time.monotonic())
        self._diagnostics.publish(report(self, entries))


def main() -> int:
    """Run the node until interrupted; returns the exit code."""
    return run_node(BodyNode, "skin_body")


if __name__ == "__main__":
    sys.exit(main())
