"""The driver node: parameters, lifecycle, publishers. Decoding runs in the Driver's thread."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from tactile_cdma.msg import TactileArray, TactileSkinInfo

from ..driver import WAITING, Driver, Session
from ..errors import ParameterError, TactileError
from ..parameters import (
    BY_NAME,
    PARAMETERS,
    SIMULATION,
    STANDARD_PARAMETERS,
    Parameter,
    Value,
    check_values,
    unknown,
)
from ..pipeline import TactileFrame
from ..rest_file import rest_path
from ..skin_config import SkinConfig
from ..source import Port
from . import convert
from .contacts import ContactPublishers
from .diagnostics import SkinReport
from .services import RestKeeper

NODE_NAME = "skin"
APART_NODES = 256
CALIBRATING = {"calibration_file", "compensation"}
"""Setting one of these makes the calibration be read again."""
RETRY_S = 2.0
STAMP_JITTER_NS = 1_000_000
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
PICTURE = QoSProfile(depth=2, reliability=ReliabilityPolicy.RELIABLE)


class SkinNode(LifecycleNode):
    """Publishes one skin patch.

    configure checks the parameters and opens the port, activate streams, deactivate stops and
    closes the port. With `autostart` the node does both by itself, and tries again for as long
    as the reason for a failure lasts.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__(
            NODE_NAME, automatically_declare_parameters_from_overrides=True, **node_options
        )
        self._faults: dict[str, str] = {}
        self._declare_parameters()
        self.add_on_set_parameters_callback(self._on_set)
        self._live = self._values()  # get_parameter takes longer than building a message
        self._config: SkinConfig | None = None
        self._port: Port | None = None
        self._driver: Driver | None = None
        self._info_id = 0
        self._latest: TactileFrame | None = None
        self._drawn: TactileFrame | None = None
        self._last_failure = ""
        self._report = SkinReport(self.get_fully_qualified_name())
        self._rest = RestKeeper(self, self._publish_info)
        self._last_stamp_ns = 0
        self._silence_due_s = 0.0  # device time from which a frame without words is published again
        # rclpy lets a transition that is impossible in the present state end the executor.
        self._service_change_state.callback = partial(
            _refuse_impossible, self, self._service_change_state.callback
        )
        self._array_publisher = self.create_lifecycle_publisher(
            TactileArray, "~/tactile", qos_profile_sensor_data
        )
        self._info_publisher = self.create_lifecycle_publisher(TactileSkinInfo, "~/info", LATCHED)
        self._image_publisher = self.create_lifecycle_publisher(Image, "~/heatmap", PICTURE)
        self._contacts = ContactPublishers(self)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # goes on where simulated time stands
        self._diagnostics_timer = self.create_timer(1.0, self._publish_diagnostics, clock=steady)
        self._heatmap_timer = self.create_timer(
            1.0 / float(self._value("heatmap_rate_hz")),
            self._publish_heatmap,
            clock=steady,
            autostart=False,
        )
        self._start_timer = self.create_timer(RETRY_S, self._start, clock=steady)
        if self._value("autostart"):
            self._start()
        else:
            self._start_timer.cancel()

    # Parameters

    def _declare_parameters(self) -> None:
        """Declare the table; a wrong override is kept as a fault that forbids configuring."""
        given = {name: p.value for name, p in self.get_parameters_by_prefix("").items()}
        for name in given:
            if name not in BY_NAME and not name.startswith(STANDARD_PARAMETERS):
                self._fault(name, f"{unknown(name, BY_NAME)} (correct it and start the node again)")
        for parameter in PARAMETERS:
            if parameter.name in given:
                self.undeclare_parameter(parameter.name)
            value = parameter.default
            try:
                value = parameter.check(given.get(parameter.name, value))
            except ParameterError as error:
                self._fault(parameter.name, str(error))
            self.declare_parameter(
                parameter.name, value, _descriptor(parameter), ignore_override=True
            )

    def _fault(self, name: str, text: str) -> None:
        self._faults[name] = text
        self.get_logger().error(f"not starting: {text}")

    def _value(self, name: str) -> Value:
        value: Value = self.get_parameter(name).value
        return value

    def _values(self) -> dict[str, Value]:
        return {parameter.name: self._value(parameter.name) for parameter in PARAMETERS}

    def _on_set(self, changes: list[RosParameter]) -> SetParametersResult:
        """Refuse what cannot work, saying why; let live parameters take effect at once."""
        new = {change.name: change.value for change in changes if change.name in BY_NAME}
        try:
            check_values(new)
            if self._config is not None:
                fixed = [
                    name
                    for name, value in new.items()
                    if not BY_NAME[name].live and value != self._value(name)
                ]
                if fixed:
                    raise ParameterError(
                        f"{', '.join(fixed)} cannot change while configured: deactivate and clean "
                        f"up first (ros2 lifecycle set {self.get_fully_qualified_name()} "
                        "deactivate, then cleanup)"
                    )
                self._config = self._adjusted(new)
        except TactileError as error:
            return SetParametersResult(successful=False, reason=str(error))
        others = {name: fault for name, fault in self._faults.items() if name not in new}
        if self._config is None and not others:
            # Several parameters may have to change one by one: what they make together is
            # refused by configure, and only announced here.
            try:
                SkinConfig.of({**self._values(), **new})
            except TactileError as error:
                self.get_logger().warning(f"not configurable as it is now: {error}")
        self._faults = others
        self._live.update(new)
        if self._config is not None:
            self._rest.adjust(self._config)
            self._contacts.change(self._config.contact)
        return SetParametersResult(successful=True)

    def _adjusted(self, new: dict[str, Value]) -> SkinConfig:
        """The configuration with new values of live parameters; raises TactileError."""
        assert self._config is not None
        values = {**self._values(), **new}
        config = self._config.adjusted(values)
        return recalibrated(config, values) if CALIBRATING & new.keys() else config

    # Lifecycle. rclpy swallows exceptions of these callbacks, so each says what went wrong itself.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters and open the port."""
        try:
            if self._faults:
                raise ParameterError("; ".join(self._faults.values()))
            config = SkinConfig.of(self._values())
            Session(config)  # refuses what a digitizer cannot be told
            path = rest_path(str(self._value("state_folder")), self.get_fully_qualified_name())
            self._port = Port(str(self._value("port")), int(self._value("baud")))
        except TactileError as error:
            if str(error) != self._last_failure:
                self._last_failure = str(error)
                self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        self._last_failure = ""
        self._config = config
        simulated = str(self._value("port")).startswith(SIMULATION)
        self._rest.configure(config, path, simulated)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stream."""
        assert self._config is not None
        result = super().on_activate(state)
        self._driver = Driver(
            self._config,
            str(self._value("port")),
            int(self._value("baud")),
            self._publish_frame,
            self._log_problem,
        )
        spec = self._config.spec
        self.get_logger().info(
            f"opened {self._value('port')} for {spec.nodes} nodes: order {spec.order}, "
            f"{spec.bits} bits, a frame every {spec.frame_period_s * 1e3:g} ms"
        )
        self._rest.activate(self._driver)
        port, self._port = self._port, None
        self._contacts.start(self._config.layout, self._config.contact)
        self._driver.start(port)
        self._report = SkinReport(self.get_fully_qualified_name())
        self._heatmap_timer.timer_period_ns = round(1e9 / float(self._value("heatmap_rate_hz")))
        self._heatmap_timer.reset()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop streaming and close the port."""
        self._stop_driver()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the configuration, so that every parameter can change."""
        self._release()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything."""
        self._release()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall back to unconfigured."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def destroy_node(self) -> None:
        """Join the reader before its publishers go."""
        self._release()
        super().destroy_node()
        # rclpy leaves its services in the graph until the garbage collector finds them.
        self._state_machine.destroy_when_not_in_use()

    def _start(self) -> None:
        """Configure and activate, unless somebody has taken the lifecycle into their own hands."""
        if self._config is None and self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        if self._config is not None:
            self._start_timer.cancel()

    def _stop_driver(self) -> None:
        self._heatmap_timer.cancel()
        if self._driver is not None:
            self._driver.stop()
            self._rest.deactivate()
            self._driver = None
        self._latest = self._drawn = None

    def _release(self) -> None:
        self._start_timer.cancel()
        self._stop_driver()
        if self._port is not None:
            self._port.close()
            self._port = None
        self._config = None
        self._rest.release()

    # Publishing

    def _publish_info(self) -> None:
        """What frames from now on are to be read with; there are none on their way."""
        assert self._config is not None and self._driver is not None
        self._info_id += 1
        baseline = self._driver.pipeline.taxels.baseline
        self._info_publisher.publish(
            convert.skin_info(self._config, baseline, self._header_now(), self._info_id)
        )

    def _publish_frame(self, frame: TactileFrame) -> None:
        """In the driver's thread: the way from a decoded frame to the wire is one publish long."""
        assert self._config is not None
        self._latest = frame
        info_id = self._info_id
        array_asked = self._array_publisher.get_subscription_count() > 0
        header = None
        if self._is_news(frame) and (array_asked or self._contacts.asked):
            header = self._header_of(frame)
        if header and array_asked:
            self._array_publisher.publish(
                convert.tactile_array(
                    frame, self._config, header, info_id, bool(self._live["publish_voltage"])
                )
            )
        self._contacts.take(frame, header, info_id)

    def _header_of(self, frame: TactileFrame) -> Header:
        stamp_ns = self._stamp_ns(frame.t_host)
        # Two clocks are read for that, some µs apart: stamps rise all the same.
        if 0 <= self._last_stamp_ns - stamp_ns < STAMP_JITTER_NS:
            stamp_ns = self._last_stamp_ns + 1
        self._last_stamp_ns = stamp_ns
        return self._header(stamp_ns)

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

    def _publish_heatmap(self) -> None:
        frame = self._latest
        if frame is None or frame is self._drawn or self._config is None:
            return
        if not self._image_publisher.get_subscription_count():
            return
        self._drawn = frame
        self._image_publisher.publish(
            convert.heatmap_image(
                frame.readings.pressure_pa,
                self._config,
                self._header_at(frame.t_host),
                float(self._value("heatmap_max_kpa")) * 1e3,
                int(self._value("heatmap_pixels")),
            )
        )

    def _publish_diagnostics(self) -> None:
        if self._driver is None:
            entries = self._report.inactive(self._last_failure)
        else:
            entries = self._report.of(self._driver, self._latest, self._rest.tared)
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

    def _header_now(self) -> Header:
        return self._header_at(time.monotonic())

    def _header_at(self, t_host: float) -> Header:
        """A header stamped with a moment of the host's monotonic clock."""
        return self._header(self._stamp_ns(t_host))

    def _stamp_ns(self, t_host: float) -> int:
        """A moment of the host's monotonic clock in ROS time, ns."""
        age_ns = time.monotonic_ns() - round(t_host * 1e9)
        return int(self.get_clock().now().nanoseconds) - age_ns

    def _header(self, stamp_ns: int) -> Header:
        return Header(stamp=convert.stamp(stamp_ns), frame_id=str(self._live["frame_id"]))


def recalibrated(config: SkinConfig, values: dict[str, Value]) -> SkinConfig:
    """config.recalibrated(values), without holding up a stream; raises TactileError.

    Thousands of curves are read in a process of their own: a second of Python in this one would
    have the driver's thread wait for up to 80 ms at a time.
    """
    if config.spec.nodes < APART_NODES:
        return config.recalibrated(values)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        read = process.submit(config.recalibrated, values).result()
    return replace(config, calibration=read.calibration, compensation=read.compensation)


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    text = parameter.text + (f" [{parameter.unit}]" if parameter.unit else "")
    descriptor = ParameterDescriptor(description=text)
    if parameter.choices:
        descriptor.additional_constraints = "one of " + ", ".join(map(str, parameter.choices))
    elif not parameter.live:
        descriptor.additional_constraints = "takes effect on configure"
    if parameter.limits:
        low, high = parameter.limits
        if isinstance(parameter.default, float):
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        else:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    descriptor.read_only = parameter.name == "autostart"
    return descriptor


def _refuse_impossible(
    node: LifecycleNode,
    change_state: Callable[[ChangeState.Request, ChangeState.Response], ChangeState.Response],
    request: ChangeState.Request,
    response: ChangeState.Response,
) -> ChangeState.Response:
    """Answer a change_state request, also one that the present state does not allow."""
    try:
        return change_state(request, response)
    except RCLError:
        node.get_logger().error(
            f"transition {request.transition.label or request.transition.id} is not possible now"
        )
        response.success = False
        return response


def main() -> int:
    """Run the node until interrupted; returns the exit code."""
    # Signals only wake the main thread, so that everything ends in order: the executor, the
    # reader thread with its port, the node, and the ROS context last.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, UnknownROSArgsError) as error:  # a parameter file that is no YAML
        print(f"skin_driver: {error}", file=sys.stderr)
        return 1
    node = SkinNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinning = threading.Thread(target=executor.spin, name="executor")
    spinning.start()
    while not stop.wait(0.5) and spinning.is_alive():
        pass
    executor.shutdown()
    spinning.join()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0 if stop.is_set() else 1


if __name__ == "__main__":
    sys.exit(main())
