"""Pictures of the skin for people: drawn beside the stream, and only while somebody looks."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from ..parameters import Value
from ..pipeline import TactileFrame
from ..skin_config import SkinConfig
from . import convert

PICTURE = QoSProfile(depth=2, reliability=ReliabilityPolicy.RELIABLE)


class Pictures:
    """`~/heatmap` of a node: the newest frame, at most visual_rate_hz times a second.

    Frames come in the driver's thread, which only leaves them here; drawing is the executor's.
    """

    def __init__(
        self,
        node: LifecycleNode,
        live: Mapping[str, Value],
        header_at: Callable[[float], Header],
    ) -> None:
        """live: the parameters' present values; header_at: of a moment of the monotonic clock."""
        self._live, self._header_at = live, header_at
        self._config: SkinConfig | None = None
        self._latest: TactileFrame | None = None
        self._drawn: TactileFrame | None = None
        self._heatmap = node.create_lifecycle_publisher(Image, "~/heatmap", PICTURE)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # goes on where simulated time stands
        self._timer = node.create_timer(_period_s(live), self._draw, clock=steady)
        self._timer.cancel()

    def start(self, config: SkinConfig) -> None:
        """Before the first frame of a stream."""
        self._config = config
        self._timer.reset()

    def stop(self) -> None:
        """After the last one."""
        self._timer.cancel()
        self._latest = self._drawn = None

    def take(self, frame: TactileFrame) -> None:
        """The newest frame."""
        self._latest = frame

    def change(self, live: Mapping[str, Value]) -> None:
        """Draw as these values of all parameters say from now on."""
        self._timer.timer_period_ns = round(_period_s(live) * 1e9)

    def _draw(self) -> None:
        frame = self._latest
        if frame is None or frame is self._drawn or self._config is None:
            return
        if not self._heatmap.get_subscription_count():
            return
        self._drawn = frame
        self._heatmap.publish(
            convert.heatmap_image(
                frame.readings.pressure_pa,
                self._config,
                self._header_at(frame.t_host),
                float(self._live["colour_max_kpa"]) * 1e3,
                int(self._live["heatmap_pixels"]),
            )
        )


def _period_s(live: Mapping[str, Value]) -> float:
    return 1 / float(live["visual_rate_hz"])
