# SPDX-License-Identifier: Apache-2.0

"""Publishes what people look at: heatmap, pressure image, points and markers of one skin."""

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from ...config.parameters import Values
from ...config.skin_config import SkinConfig, contact_thresholds
from ...driver.pipeline import TactileFrame
from ...messages.cdr import Heading
from ...readings.contact import ContactTracker
from ...readings.status import is_certain
from ...views.cloud import POINT, Cloud
from ...views.heatmap import heatmap, pressure_raster
from ..common.convert import image, point_cloud
from ..common.nodes import STEADY
from ..common.qos import PICTURE
from .frames import FramePublishers
from .markers import SkinMarkers

TOPICS = {"heatmap": Image, "pressure_image": Image, "points": PointCloud2, "markers": MarkerArray}
LOOK_S = 0.25
"""Interval of `Pictures.look`, s; chosen: nobody minds the wait."""
FADE_PERIODS, LEAST_FADE_S = 3, 1.0
"""Markers vanish that were not renewed for this many periods of pictures, and this many s; then
other pictures are drawn without readings. Chosen: two late pictures do not make them flicker."""


class Pictures:
    """Pictures of a skin, each drawn only while somebody subscribes.

    A timer draws the latest frame, at most visual_rate_hz times a second and no frame twice, from
    a `look` that finds subscribers until there are none. When no more frames come, a last picture
    shows that nothing is read: a viewer would keep old pressures.
    """

    def __init__(
        self,
        node: LifecycleNode,
        live: Values,
        frames: FramePublishers,
        heading_at: Callable[[float], Heading],
    ) -> None:
        """heading_at: of a host time, s."""
        self._live, self._frames, self._heading_at = live, frames, heading_at
        self._context = node.context
        self._publishers = {
            name: node.create_lifecycle_publisher(kind, f"~/{name}", PICTURE)
            for name, kind in TOPICS.items()
        }
        self._config: SkinConfig | None = None  # while active
        self._drawn: TactileFrame | None = None
        self._drawn_s = math.inf  # when, unless a picture without readings followed
        self._published: dict[str, bytes] = {}  # the last message of each topic
        self._timer = node.create_timer(_period_s(live), self._turn, clock=STEADY)
        self._timer.cancel()

    def start(self, config: SkinConfig) -> None:
        # Contacts are followed from picture to picture: those of ~/contacts exist only while
        # somebody subscribes to them, in the driver's thread, which this spares.
        self._tracker = ContactTracker(config.layout, config.contact)
        self._markers = SkinMarkers(config.layout)
        self._cloud = Cloud(config.layout.positions_m, config.layout.normals)
        self._config = config

    def stop(self) -> None:
        """Show that nothing is read any more; to be called while the publishers are active."""
        self._timer.cancel()
        if self._config is not None and self._context.ok():
            self._draw_nothing(self._config)
        self._config = self._drawn = None

    def change(self, values: Values) -> None:
        """Use other values of parameters; all of them, and they fit each other."""
        if self._config is not None:
            self._tracker.thresholds = contact_thresholds(values)
            if not self._timer.is_canceled() and _period_s(values) != _period_s(self._live):
                self._turn_every(_period_s(values))  # a timer that is reset comes late

    def look(self) -> None:
        """Draw from now on if somebody subscribes; to be called every LOOK_S."""
        if self._config is not None and self._timer.is_canceled() and self._asked:
            self._turn_every(_period_s(self._live))

    @property
    def _asked(self) -> list[str]:
        return [name for name, p in self._publishers.items() if p.get_subscription_count()]

    def _turn_every(self, period_s: float) -> None:
        self._timer.timer_period_ns = round(period_s * 1e9)
        self._timer.reset()

    def _turn(self) -> None:
        if asked := self._asked:
            self._draw(asked)
        else:
            self._timer.cancel()

    def _draw(self, topics: list[str]) -> None:
        latest = self._frames.latest  # with the heading of the frame's other messages
        if latest is None or self._config is None:
            return
        frame, heading = latest
        if frame is not self._drawn:
            self._drawn, self._drawn_s = frame, time.monotonic()
            self._publish(topics, self._config, frame, heading or self._heading_at(frame.t_host))
        elif time.monotonic() - self._drawn_s > self._fade_s(self._config):
            self._draw_nothing(self._config)

    def _draw_nothing(self, config: SkinConfig) -> None:
        """Draw once that there are no readings; markers vanish by themselves."""
        if self._drawn is None or math.isinf(self._drawn_s):
            return
        self._drawn_s, readings = math.inf, self._drawn.readings
        none = np.full_like(readings.pressure_pa, np.nan)
        frame = replace(self._drawn, readings=replace(readings, pressure_pa=none))
        heading = self._heading_at(time.monotonic())
        self._publish([name for name in self._asked if name != "markers"], config, frame, heading)

    def _publish(
        self, topics: list[str], config: SkinConfig, frame: TactileFrame, heading: Heading
    ) -> None:
        for topic in topics:
            # Kept, as its memory would go back to the system, and every page of the next message
            # be a fault: 3 ms for a heatmap of 3 MB.
            self._published[topic] = self._message(topic, config, frame, heading)
            self._publishers[topic].publish(self._published[topic])

    def _fade_s(self, config: SkinConfig) -> float:
        """How long a picture holds that no other follows, s."""
        periods_s = FADE_PERIODS * max(_period_s(self._live), config.spec.frame_period_s)
        return max(LEAST_FADE_S, periods_s)

    def _message(
        self, topic: str, config: SkinConfig, frame: TactileFrame, heading: Heading
    ) -> bytes:
        """Draw a frame for one of TOPICS, by the live parameters."""
        live, layout, readings = self._live, config.layout, frame.readings
        pressure_pa, unsure = readings.pressure_pa, ~is_certain(readings.status)
        max_pa, gamma = float(live["colour_max_kpa"]) * 1e3, float(live["colour_gamma"])
        if topic == "heatmap":
            pixels = int(live["heatmap_pixels"])
            picture = heatmap(pressure_pa, layout, max_pa, pixels, unsure, gamma)
            return image(picture, "rgb8", heading)
        if topic == "markers":
            contacts = self._tracker.update(readings, frame.t_middle)
            fade_s = self._fade_s(config)
            return self._markers.markers(
                pressure_pa, max_pa, contacts, heading, fade_s, unsure, gamma
            )
        # For machines, as a picture has no flags: uncertain pressures are NaN.
        certain_pa = np.where(unsure, np.float32(np.nan), pressure_pa)
        if topic == "points":
            return point_cloud(POINT, [self._cloud.points(certain_pa, max_pa, gamma)], heading)
        return image(pressure_raster(certain_pa, layout), "32FC1", heading)


def _period_s(values: Values) -> float:
    return 1.0 / float(values["visual_rate_hz"])
