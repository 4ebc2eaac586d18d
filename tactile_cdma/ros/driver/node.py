# SPDX-License-Identifier: Apache-2.0

"""The driver node: lifecycle and publishing. Decoding runs in the Driver's thread."""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecyclePublisher, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile, qos_profile_sensor_data

from tactile_cdma.msg import TactileArray, TactileSkinInfo

from ...base.errors import ParameterError, TactileError
from ...config.body_file import NODE_NAME
from ...config.parameters import Values
from ...config.skin_config import SkinConfig
from ...driver.driver import WAITING, Driver
from ...driver.pipeline import TactileFrame
from ...driver.rest_keeper import RestKeeper
from ...driver.session import Session
from ...readings.rest_file import rest_path
from ...wire.port import Port
from ..common import convert
from ..common.lifecycle import ManagedNode, reported
from ..common.process import run_node
from ..common.qos import LATCHED
from .contacts import ContactPublishers
from .diagnostics import SkinReport
from .mount import TF_STATIC, Mount, transform_of
from .parameters import NodeParameters
from .pictures import Pictures
from .services import RestServices
from .stamps import Stamps

APART_NODES = 256
CALIBRATING = {"calibration_file", "compensation"}
"""Setting one of these makes the calibration be read again."""
RETRY_S = 2.0


class SkinNode(ManagedNode):
    """Publishes one skin patch.

    configure checks the parameters and opens the port, activate streams, deactivate stops and
    closes the port. With `autostart` the node does both by itself, and tries again for as long
    as the reason for a failure lasts.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__(
            NODE_NAME, automatically_declare_parameters_from_overrides=True, **node_options
        )
        self._config: SkinConfig | None = None
        self._port: Port | None = None
        self._driver: Driver | None = None
        self._declared = NodeParameters(self, self._change)
        self._live = self._declared.values
        self._stamps = Stamps(self, self._live)
        self._info_id = 0
        self._latest: TactileFrame | None = None
        self._last_failure = ""
        self._report = SkinReport(self.get_fully_qualified_name())
        self._silence_due_s = 0.0  # device time from which a frame without words is published again
        self._rest: RestKeeper | None = None
        RestServices(self, lambda: self._rest)
        self._array_publisher = self.create_lifecycle_publisher(
            TactileArray, "~/tactile", qos_profile_sensor_data
        )
        self._info_publisher = self.create_lifecycle_publisher(TactileSkinInfo, "~/info", LATCHED)
        self._contacts = ContactPublishers(self)
        self._pictures = Pictures(self, self._live, self._stamps.at)
        self._mount = Mount(self, self._declared.offered(LATCHED, TF_STATIC))
        self._diagnostics_publisher = self.create_publisher(
            DiagnosticArray,
            "/diagnostics",
            self._declared.offered(QoSProfile(depth=10), "/diagnostics"),
        )
        self._declared.check_all_taken()
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # goes on where simulated time stands
        self._diagnostics_timer = self.create_timer(1.0, self._publish_diagnostics, clock=steady)
        self._start_timer = self.create_timer(RETRY_S, self._start, clock=steady)
        if self._live["autostart"]:
            self._start()
        else:
            self._start_timer.cancel()

    def create_lifecycle_publisher(
        self, kind: type, topic: str, profile: QoSProfile
    ) -> LifecyclePublisher:
        """A publisher whose QoS parameters can override."""
        return super().create_lifecycle_publisher(
            kind, topic, self._declared.offered(profile, topic)
        )

    def set_parameters_atomically(self, changes: list[RosParameter]) -> SetParametersResult:
        """Take all of them or none; this is what the parameter services call."""
        try:
            return super().set_parameters_atomically(self._declared.checked(changes))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))

    def _change(self, values: Values, new: set[str]) -> None:
        """Let new values of parameters take effect; raises TactileError to refuse them."""
        if self._config is not None and self._rest is not None:
            config = self._config.adjusted(values)
            if CALIBRATING & new:
                config = recalibrated(config, values)
            self._config = config
            self._rest.adjust(config)
            self._contacts.change(config.contact)
            self._mount.change(transform_of(values))
        elif not self._declared.faults:
            # Several parameters may have to change one by one: what they make together is
            # refused by configure, and only announced here.
            try:
                SkinConfig.of(values)
                transform_of(values)
            except TactileError as error:
                self.get_logger().warning(f"not configurable as it is now: {error}")
        self._pictures.change(values)

    # Lifecycle

    @reported
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters and open the port."""
        try:
            if self._declared.faults:
                raise ParameterError("; ".join(self._declared.faults.values()))
            config = SkinConfig.of(self._live)
            Session(config)  # refuses what a digitizer cannot be told
            transform = transform_of(self._live)
            path = rest_path(str(self._live["state_folder"]), self.get_fully_qualified_name())
            self._port = Port(str(self._live["port"]), int(self._live["baud"]))
        except TactileError as error:
            if str(error) != self._last_failure:
                self._last_failure = str(error)
                self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        self._last_failure = ""
        self._config, self._declared.fixed = config, True
        self._rest = RestKeeper(
            config, str(self._live["port"]), path, self.get_logger(), self._publish_info
        )
        self._mount.configure(transform)
        return super().on_configure(state)

    @reported
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stream."""
        assert self._config is not None and self._rest is not None
        result = super().on_activate(state)
        self._driver = Driver(
            self._config,
            str(self._live["port"]),
            int(self._live["baud"]),
            self._publish_frame,
            self._log_problem,
        )
        spec = self._config.spec
        self.get_logger().info(
            f"opened {self._live['port']} for {spec.nodes} nodes: order {spec.order}, "
            f"{spec.bits} bits, a frame every {spec.frame_period_s * 1e3:g} ms"
        )
        self._rest.activate(self._driver)
        self._contacts.start(self._config.layout, self._config.contact)
        self._pictures.start(self._config)
        self._driver.start(self._port)
        self._port = None  # the driver's now
        self._report = SkinReport(self.get_fully_qualified_name())
        return result

    @reported
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop streaming and close the port."""
        self._stop_driver()
        return super().on_deactivate(state)

    @reported
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the configuration, so that every parameter can change."""
        self._release()
        return super().on_cleanup(state)

    @reported
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything."""
        self._release()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall back to unconfigured."""
        self._release()
        self._last_failure = f"internal error while {state.label}, see the log"
        return TransitionCallbackReturn.SUCCESS

    def destroy_node(self) -> None:
        """Join the reader before its publishers go."""
        self._release()
        super().destroy_node()

    def _start(self) -> None:
        """Configure and activate, unless somebody has taken the lifecycle into their own hands."""
        if self._config is None and self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        if self._config is not None:
            self._start_timer.cancel()

    def _stop_driver(self) -> None:
        if self._driver is not None and self._rest is not None:
            self._driver.stop()
            self._rest.deactivate()
            self._driver = None
        self._pictures.stop()
        self._latest = None

    def _release(self) -> None:
        self._start_timer.cancel()
        self._stop_driver()
        if self._port is not None:
            self._port.close()
            self._port = None
        self._config = self._rest = None
        self._declared.fixed = False
        self._mount.release()

    # Publishing

    def _publish_info(self) -> None:
        """What frames from now on are to be read with; there are none on their way."""
        assert self._config is not None and self._driver is not None
        self._info_id += 1
        baseline = self._driver.pipeline.taxels.baseline
        self._info_publisher.publish(
            convert.skin_info(self._config, baseline, self._stamps.now(), self._info_id)
        )

    def _publish_frame(self, frame: TactileFrame) -> None:
        """In the driver's thread: the way from a decoded frame to the wire is one publish long.

        Several messages share one header: nobody changes a message that was published.
        """
        assert self._config is not None
        self._latest = frame
        info_id = self._info_id
        array_asked = self._array_publisher.get_subscription_count() > 0
        header = None
        if self._is_news(frame) and (array_asked or self._contacts.asked):
            header = self._stamps.rising(frame.t_host)
        if header and array_asked:
            self._array_publisher.publish(
                convert.tactile_array(
                    frame, self._config, header, info_id, bool(self._live["publish_voltage"])
                )
            )
        self._contacts.take(frame, header, info_id)
        self._pictures.take(frame, header)

    def _is_news(self, frame: TactileFrame) -> bool:
        """Whether a node spoke, or the last frame without words is long enough ago."""
        rate_hz = float(self._live["idle_rate_hz"])
        if not rate_hz or frame.words.active.any():
            self._silence_due_s = 0.0  # the first silent frame tells who fell silent
            return True
        # Device time may start again, from nearly zero.
        if 0.0 <= self._silence_due_s - frame.t_middle <= 1 / rate_hz:
            return False
        self._silence_due_s = frame.t_middle + 1 / rate_hz
        return True

    def _publish_diagnostics(self) -> None:
        if self._driver is None or self._rest is None:
            entries = self._report.inactive(self._last_failure)
        else:
            drivers = self.count_publishers(self._array_publisher.topic_name)
            entries = self._report.of(self._driver, self._latest, self._rest.tared, drivers)
            self._rest.tick()
        message = DiagnosticArray(status=entries)
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(message)

    def _log_problem(self, problem: str | None) -> None:
        if problem is None:
            self.get_logger().info("receiving frames")
        elif problem == WAITING:
            self.get_logger().info(problem)
        else:
            self.get_logger().error(problem)


def recalibrated(config: SkinConfig, values: Values) -> SkinConfig:
    """The result of config.recalibrated, without holding up a stream; raises TactileError.

    Thousands of curves are read in a process of their own: a second of Python in this one would
    have the driver's thread wait for up to 80 ms at a time.
    """
    if config.spec.nodes < APART_NODES:
        return config.recalibrated(values)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        read = process.submit(config.recalibrated, values).result()
    return replace(config, calibration=read.calibration, compensation=read.compensation)


def main() -> int:
    """Run the node until interrupted; returns the exit code."""
    return run_node(SkinNode, "skin_driver")


if __name__ == "__main__":
    sys.exit(main())
