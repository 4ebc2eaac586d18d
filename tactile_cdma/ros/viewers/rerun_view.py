# SPDX-License-Identifier: Apache-2.0

"""Shows patches in the Rerun viewer, in a window or a browser, or saves what it would show.

Rerun (rerun.io) is not among what the driver needs: `make view` installs it.
"""

from __future__ import annotations

import argparse
import os
import sys
from functools import partial
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo

from ...base.errors import TransformError
from ..common.convert import nanoseconds, rows
from ..common.process import viewing
from ..common.qos import LATCHED
from ..common.transforms import COMPLAINT_S, TransformListener
from .complaints import Complaints
from .patches import ARRAY_TOPIC, full_name, layout_of
from .view import QUEUE

try:
    import rerun as rr
except ImportError:
    sys.exit("rerun-sdk is not installed: `make view` does it, or pip install rerun-sdk")

from .rerun_scene import PatchScene, blueprint

RATE_HZ = 30.0
"""Updates of the viewer per second; chosen: what a screen shows smoothly."""
DISCOVERY_S = 1.0
"""Interval of looks for new patches; chosen."""
BLUEPRINT_S = 2.0
"""Least time between two blueprints; chosen long, because each undoes what the user has moved: the
patches that start together make one."""
WEB_PORT = 9090
"""The port that Rerun's web viewer has by default."""
_TEXT_LEVELS = {
    DiagnosticStatus.OK: "INFO",
    DiagnosticStatus.WARN: "WARN",
    DiagnosticStatus.STALE: "WARN",
    DiagnosticStatus.ERROR: "ERROR",
}


class RerunView(Node):
    """Subscribes to patches and logs them. patches: their full names; empty: all that appear."""

    def __init__(self, recording: rr.RecordingStream, patches: list[str], max_pa: float) -> None:
        super().__init__("skin_rerun")
        self._recording = recording
        self._max_pa = max_pa
        self._scenes: dict[str, PatchScene] = {}
        self._frames: dict[PatchScene, str] = {}  # of their geometry
        self._roots: dict[PatchScene, str] = {}  # those they hang from
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
            if array in types and name == ARRAY_TOPIC and patch.strip("/") not in self._scenes:
                self._watch(patch)

    def _watch(self, patch: str) -> None:
        """Subscribe to a patch's topics."""
        path = patch.strip("/")
        scene = PatchScene(self._recording, path, len(self._scenes), self._max_pa)
        self._scenes[path] = scene
        complaints = Complaints(path)
        subscriptions = (
            (TactileSkinInfo, f"{patch}/info", partial(self._place, scene), LATCHED),
            (TactileArray, f"{patch}/{ARRAY_TOPIC}", partial(_take_frame, scene), QUEUE),
            (TactileContacts, f"{patch}/contacts", partial(_take_contacts, scene), QUEUE),
            (DiagnosticArray, "/diagnostics", partial(_complain, scene, complaints), 10),
        )
        for kind, topic, callback, qos in subscriptions:
            self.create_subscription(kind, topic, callback, qos)
        self.get_logger().info(f"watching {patch}")

    def _place(self, scene: PatchScene, info: TactileSkinInfo) -> None:
        scene.place(layout_of(info))
        self._frames[scene] = info.header.frame_id

    def flush(self) -> None:
        """Log what came since the last call, every patch where its frame is now."""
        for scene, frame in self._frames.items():
            try:
                self._roots[scene], scene.pose = self._transforms.tree.root(frame)
            except TransformError as error:
                self.get_logger().warning(str(error), throttle_duration_sec=COMPLAINT_S)
        for scene in self._scenes.values():
            scene.flush()

    def show(self) -> None:
        """Send a new blueprint if patches, or the frames they hang from, have changed."""
        if self._roots != self._shown:
            self._shown = dict(self._roots)
            self._recording.send_blueprint(blueprint(self._shown))


def _take_frame(scene: PatchScene, message: TactileArray) -> None:
    pressure_pa = np.array(message.pressure, dtype=np.float32)
    scene.take_frame(nanoseconds(message.header.stamp), message.device_time_us, pressure_pa)


def _take_contacts(scene: PatchScene, message: TactileContacts) -> None:
    scene.take_contacts(
        nanoseconds(message.header.stamp),
        [contact.id for contact in message.contacts],
        rows([contact.position for contact in message.contacts]),
        rows([contact.force for contact in message.contacts]),
    )


def _complain(scene: PatchScene, complaints: Complaints, message: DiagnosticArray) -> None:
    for entry in complaints.take(message):
        text = f"{entry.name}: {entry.message}"
        scene.complain(nanoseconds(message.header.stamp), _TEXT_LEVELS[entry.level], text)


def main() -> int:
    """Show until interrupted."""
    parser = argparse.ArgumentParser(prog="skin_rerun", description=__doc__)
    parser.add_argument("--patches", default="", help="left_palm,/arm/skin; default: all there are")
    parser.add_argument("--max-kpa", type=float, default=140.0, help="top of the colour scale")
    parser.add_argument("--memory", default="1GB", help="the oldest is dropped above this")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--web", action="store_true", help="in a browser")
    where.add_argument("--save", metavar="FILE.rrd", help="to be opened later, with `rerun`")
    arguments = parser.parse_args(remove_ros_args(sys.argv)[1:])
    if not arguments.max_kpa > 0:
        parser.error(f"--max-kpa is {arguments.max_kpa:g}; it must be above 0")
    patches = [full_name(name) for name in arguments.patches.split(",") if name]
    recording = rr.RecordingStream("tactile_cdma")
    try:
        if arguments.save:
            recording.save(arguments.save)
        else:
            show(recording, arguments.web, arguments.memory)
    except (OSError, RuntimeError, ValueError) as error:
        print(f"the viewer cannot be started: {error}", file=sys.stderr)
        return 1
    with viewing(lambda: RerunView(recording, patches, arguments.max_kpa * 1e3)) as program:
        program.spin()
        program.node.flush()
    recording.flush(timeout_sec=5.0)
    recording.disconnect()
    return 0


def show(recording: rr.RecordingStream, web: bool, memory: str) -> None:
    """Open a window; without a display, or if asked to, serve the viewer for browsers."""
    display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if display and not web:
        # That of a venv is not on the path unless it is activated.
        viewer = Path(sys.executable).with_name("rerun")
        path = str(viewer) if viewer.exists() else None
        rr.spawn(memory_limit=memory, executable_path=path, recording=recording)
        return
    if not web:
        print("no display here: serving the viewer for browsers instead", flush=True)
    source = recording.serve_grpc(server_memory_limit=memory)
    rr.serve_web_viewer(web_port=WEB_PORT, open_browser=display, connect_to=source)
    print(f"open http://localhost:{WEB_PORT}/?url={source}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
