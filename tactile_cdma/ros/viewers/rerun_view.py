# SPDX-License-Identifier: Apache-2.0

"""Shows patches in the Rerun viewer, in a window or a browser, or saves what it would show.

Rerun (rerun.io) is not among what the driver needs: `make view` installs it.
"""

import argparse
import sys

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo

from ...base.errors import MessageError, TransformError
from ...base.program import program
from ...config.arguments import positive
from ...config.body_file import full_name
from ...views.rerun_window import RATE_HZ, add_rerun_options, recording
from ..common.convert import layout_of, nanoseconds, readings_of, rows
from ..common.nodes import all_or_nothing
from ..common.process import own_words, running
from ..common.qos import LATCHED, QUEUE
from ..common.transforms import COMPLAINT_S, TransformListener
from .watched import LEVELS, Complaints

try:
    import rerun as rr
except ImportError:
    sys.exit("rerun-sdk is not installed: `make view` does it, or pip install rerun-sdk")

from ...views.rerun_scene import PatchScene, Touches, blueprint

DISCOVERY_S = 1.0
"""Interval of looks for new patches; chosen."""
BLUEPRINT_S = 2.0
"""Least time between two blueprints; chosen long, because each undoes what the user has moved: the
patches that start together make one."""
_TEXT_LEVELS = {"OK": "INFO", "STALE": "WARN"}
"""Rerun's words for levels of diagnostics, where they differ."""


class PublishedPatch(PatchScene):
    """A scene that takes messages. frame_id: of its layout; empty: none came yet."""

    def __init__(self, recording: rr.RecordingStream, path: str, index: int, max_pa: float) -> None:
        super().__init__(recording, path, index, max_pa)
        self.frame_id = ""
        self._complaints = Complaints(path)

    def take_info(self, message: TactileSkinInfo) -> None:
        self.place(layout_of(message))
        self.frame_id = message.header.frame_id

    def take_array(self, message: TactileArray) -> None:
        stamp_ns = nanoseconds(message.header.stamp)
        self.take_frame(stamp_ns, message.device_time_us, *readings_of(message))

    def take_contact_list(self, message: TactileContacts) -> None:
        contacts = message.contacts
        position_m = rows([contact.position for contact in contacts])
        force_n = rows([contact.force for contact in contacts])
        if not (np.isfinite(position_m).all() and np.isfinite(force_n).all()):
            raise MessageError(f"frame {message.sequence} has contacts without a place or force")
        ids, lower_bound = [c.id for c in contacts], [c.lower_bound for c in contacts]
        total_n = float(np.linalg.norm(rows([message.wrench.force])))
        touches = Touches(ids, position_m, force_n, lower_bound)
        self.take_contacts(nanoseconds(message.header.stamp), touches, total_n)

    def take_diagnostics(self, message: DiagnosticArray) -> None:
        """Log what has changed in the entries of the driver."""
        for entry in self._complaints.take(message):
            level = _TEXT_LEVELS.get(LEVELS[entry.level], LEVELS[entry.level])
            stamp_ns = nanoseconds(message.header.stamp)
            self.say(stamp_ns, f"{entry.name}: {entry.message}", level)


class RerunView(Node):
    """Subscribes to patches and logs them. patches: their full names; empty: all that appear."""

    @all_or_nothing
    def __init__(self, stream: rr.RecordingStream, patches: list[str], max_pa: float) -> None:
        super().__init__("skin_rerun")
        self._recording = stream
        self._max_pa = max_pa
        self._scenes: dict[str, PublishedPatch] = {}
        self._roots: dict[PatchScene, str] = {}  # the frames that theirs hang from
        self._shown: dict[PatchScene, str] = {}  # the same, as the viewer is laid out for
        self._transforms = TransformListener(self)
        self._transforms.follow(True)
        for patch in patches:
            self._watch(patch)
        if not patches:
            self.create_timer(DISCOVERY_S, self._discover)
        self.create_timer(1 / RATE_HZ, self.flush)
        self.create_timer(BLUEPRINT_S, self.show)

    def _discover(self) -> None:
        array = "tactile_cdma/msg/TactileArray"
        for topic, types in self.get_topic_names_and_types():
            patch, _, name = topic.rpartition("/")
            if array in types and name == "tactile" and patch.strip("/") not in self._scenes:
                self._watch(patch)

    def _watch(self, patch: str) -> None:
        path = patch.strip("/")
        scene = PublishedPatch(self._recording, path, len(self._scenes), self._max_pa)
        self._scenes[path] = scene
        for kind, topic, take, qos in (
            (TactileSkinInfo, f"{patch}/info", scene.take_info, LATCHED),
            (TactileArray, f"{patch}/tactile", scene.take_array, QUEUE),
            (TactileContacts, f"{patch}/contacts", scene.take_contact_list, QUEUE),
            (DiagnosticArray, "/diagnostics", scene.take_diagnostics, 10),
        ):
            self.create_subscription(kind, topic, take, qos)
        self.get_logger().info(f"watching {patch}")

    def flush(self) -> None:
        """Log what came since the last call, every patch where its frame is now."""
        for scene in self._scenes.values():
            if scene.frame_id:
                try:
                    self._roots[scene], scene.pose = self._transforms.tree.root(scene.frame_id)
                except TransformError as error:
                    self.get_logger().warning(str(error), throttle_duration_sec=COMPLAINT_S)
            scene.flush()

    def show(self) -> None:
        """Send a new blueprint if patches, or the frames they hang from, have changed."""
        if self._roots != self._shown:
            self._shown = dict(self._roots)
            self._recording.send_blueprint(blueprint(self._shown))


@program("skin_rerun")
def main() -> int:
    """Show until interrupted."""
    parser = argparse.ArgumentParser(prog="skin_rerun", description=__doc__)
    parser.add_argument("--patches", default="", help="left_palm,/arm/skin; default: all there are")
    parser.add_argument("--max-kpa", type=positive, default=140.0, help="top of the colour scale")
    add_rerun_options(parser)
    arguments = parser.parse_args(own_words())
    patches = [full_name(name) for name in arguments.patches.split(",") if name]
    with (
        recording(arguments) as stream,
        running(lambda: RerunView(stream, patches, arguments.max_kpa * 1e3)) as process,
    ):
        process.spin()
        process.node.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
