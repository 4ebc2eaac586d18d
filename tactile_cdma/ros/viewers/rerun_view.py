# SPDX-License-Identifier: Apache-2.0

"""Shows patches in the Rerun viewer, in a window or a browser, or saves what it would show.

Rerun (rerun.io) is not among what the driver needs: `make view` installs it.
"""

import argparse
import os
import sys
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo

from ...base.errors import TransformError
from ...config.arguments import positive
from ..common.nodes import all_or_nothing
from ..common.process import running
from ..common.qos import LATCHED, QUEUE
from ..common.transforms import COMPLAINT_S, TransformListener
from .patches import ARRAY_TOPIC, full_name

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


class RerunView(Node):
    """Subscribes to patches and logs them. patches: their full names; empty: all that appear."""

    @all_or_nothing
    def __init__(self, recording: rr.RecordingStream, patches: list[str], max_pa: float) -> None:
        super().__init__("skin_rerun")
        self._recording = recording
        self._max_pa = max_pa
        self._scenes: dict[str, PatchScene] = {}
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
            if array in types and name == ARRAY_TOPIC and patch.strip("/") not in self._scenes:
                self._watch(patch)

    def _watch(self, patch: str) -> None:
        path = patch.strip("/")
        scene = PatchScene(self._recording, path, len(self._scenes), self._max_pa)
        self._scenes[path] = scene
        for kind, topic, take, qos in (
            (TactileSkinInfo, f"{patch}/info", scene.place, LATCHED),
            (TactileArray, f"{patch}/{ARRAY_TOPIC}", scene.take_frame, QUEUE),
            (TactileContacts, f"{patch}/contacts", scene.take_contacts, QUEUE),
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


def main() -> int:
    """Show until interrupted."""
    parser = argparse.ArgumentParser(prog="skin_rerun", description=__doc__)
    parser.add_argument("--patches", default="", help="left_palm,/arm/skin; default: all there are")
    parser.add_argument("--max-kpa", type=positive, default=140.0, help="top of the colour scale")
    parser.add_argument("--memory", default="1GB", help="the oldest is dropped above this")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--web", action="store_true", help="in a browser")
    where.add_argument("--save", metavar="FILE.rrd", help="to be opened later, with `rerun`")
    arguments = parser.parse_args(remove_ros_args(sys.argv)[1:])
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
    with running(lambda: RerunView(recording, patches, arguments.max_kpa * 1e3)) as program:
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
