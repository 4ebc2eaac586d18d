# SPDX-License-Identifier: Apache-2.0

"""The driver node: lifecycle, parameters and diagnostics of one skin patch."""

import sys
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecyclePublisher, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile

from ...base.errors import ParameterError, RestError, TactileError
from ...base.program import program
from ...base.text import plain
from ...config.body_file import NODE_NAME
from ...config.parameters import SIMULATION, Values
from ...config.skin_config import CURVE_PARAMETERS, SkinConfig
from ...driver.checkup import rivals
from ...driver.digitizer import Origin, SourceWatch
from ...driver.driver import NOT_YET, Driver
from ...driver.session import Session
from ...rest.rest_file import rest_path
from ...rest.rest_keeper import RestKeeper
from ...wire.messages import Info
from ...wire.port import Port, is_remote
from ..common.convert import report
from ..common.nodes import STEADY, TAKEN, ManagedNode, all_or_nothing, changing, reported
from ..common.process import run_node
from ..common.qos import LATCHED
from .curves import recalibrated
from .diagnostics import SkinReport
from .frames import FramePublishers
from .mount import TF_STATIC, Mount, transform_of
from .objects import ObjectsInput
from .parameters import NodeParameters
from .pictures import LOOK_S, Pictures
from .services import RestServices
from .stamps import Stamps

REVIEW_S = 0.2
"""Time after a change of parameters at which they are looked at together, s. Chosen: `ros2 param
load` sets all of a file within it, and a person does not yet type the next command."""
RETRY_S = 2.0
"""Time between attempts to start, s. Chosen: short for whoever has just plugged in a cable."""


class SkinNode(ManagedNode):
    """Publishes one skin patch.

    configure checks the parameters and opens the port, unless that is on another machine; activate
    streams, deactivate stops and closes the port. With `autostart` the node does both by itself,
    and tries again while the reason for a failure lasts. Decoding runs in the Driver's thread.
    pictures: what people look at. look_timer: calls their `look`.
    """

    @all_or_nothing
    def __init__(self, **node_options: Any) -> None:
        super().__init__(
            NODE_NAME, automatically_declare_parameters_from_overrides=True, **node_options
        )
        self._rest: RestKeeper | None = None  # while configured; it has the configuration
        self._port: Port | None = None  # from configure on, until the driver takes it
        self._driver: Driver | None = None  # while active
        self._heard: Info | None = None  # what _watch has taken in since activate
        self._has_rivals = False  # as last logged
        self._last_failure = ""
        self._declared = NodeParameters(self, self._change)
        self._live = self._declared.values
        self._watch = SourceWatch(str(self._live["port"]))  # of the port configured last
        self._report = SkinReport(self.get_fully_qualified_name())
        stamps = Stamps(self, self._live)
        self._frames = FramePublishers(self, self._live, stamps)
        self.pictures = Pictures(self, self._live, self._frames, stamps.at)
        self._objects = ObjectsInput(self, self._live)
        self._mount = Mount(self, self._declared.offered(LATCHED, TF_STATIC))
        self._diagnostics_publisher = self.create_publisher(
            DiagnosticArray,
            "/diagnostics",
            self._declared.offered(QoSProfile(depth=10), "/diagnostics"),
        )
        self._declared.check_all_taken()
        RestServices(self, lambda: self._rest)
        self._diagnostics_timer = self.create_timer(1.0, self._publish_diagnostics, clock=STEADY)
        self.look_timer = self.create_timer(LOOK_S, self.pictures.look, clock=STEADY)
        self._review_timer = self.create_timer(REVIEW_S, self._review, clock=STEADY)
        self._review_timer.cancel()
        self._start_timer = self.create_timer(RETRY_S, self._start, clock=STEADY)
        if self._live["autostart"]:
            self.await_listener()
            self._start()
        else:
            self._start_timer.cancel()

    def create_lifecycle_publisher(
        self, kind: type, topic: str, profile: QoSProfile
    ) -> LifecyclePublisher:
        """Create a publisher whose QoS parameters can override."""
        return super().create_lifecycle_publisher(
            kind, topic, self._declared.offered(profile, topic)
        )

    def set_parameters_atomically(self, changes: list[RosParameter]) -> SetParametersResult:
        """Take all of them or none; this is what the parameter services call."""
        try:
            changes = self._declared.checked(changing(self, changes))
            return super().set_parameters_atomically(changes) if changes else TAKEN
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))

    def _change(self, values: Values, new: set[str]) -> None:
        """Let new values of parameters take effect; raises TactileError to refuse them."""
        if self._rest is not None:
            config = self._rest.config.adjusted(values)
            if new & CURVE_PARAMETERS:
                config = recalibrated(config, values)
            self._rest.adjust(config)
            self._frames.change(config.contact)
            self._mount.show(values, config.layout)
        else:
            self._review_timer.reset()
        self.pictures.change(values)

    def _review(self) -> None:
        """Announce what configure would refuse: a combination, once all that was set is there.

        Several parameters may have to change one by one, through impossible combinations.
        """
        self._review_timer.cancel()
        if self._rest is None and not self._declared.faults:
            try:
                SkinConfig.of(self._live)
                transform_of(self._live)
            except TactileError as error:
                self.get_logger().warning(f"cannot be configured as it is: {error}")

    # Lifecycle

    @reported
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        port, watch = str(self._live["port"]), self._watch
        if watch.port != port:  # it outlasts activations of the same port
            watch = SourceWatch(port)
        url = watch.source.port
        try:
            if self._declared.faults:
                raise ParameterError("; ".join(self._declared.faults.values()))
            config = SkinConfig.of(self._live)
            Session(config)  # refuses what a digitizer cannot be told
            transform_of(self._live)  # refuses what tf does not take
            path, no_path = self._rest_path(url)
            if not self._last_failure:  # else it is tried again
                self.get_logger().info(f"opening {plain(url)}")
                if config.choice:
                    self.get_logger().info(config.choice)
            if not is_remote(url):  # else the driver does it, which holds up nothing
                self._port = Port(url, int(self._live["baud"]), config.layout)
        except TactileError as error:
            if self.is_asked or str(error) != self._last_failure:
                self._last_failure = str(error)
                self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        self._last_failure, self._declared.fixed = "", True
        self._watch = watch
        self._objects.configure(self._port)
        log = self.get_logger()
        self._rest = RestKeeper(config, url, path, log, self._publish_info, no_path)
        self._mount.show(self._live, config.layout)
        return super().on_configure(state)

    @reported
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        assert self._rest is not None
        result = super().on_activate(state)
        config, spec = self._rest.config, self._rest.config.spec
        url, baud = self._watch.source.port, int(self._live["baud"])
        self._driver = Driver(
            config, url, baud, self._frames.publish, self._log_problem, self._hear_source
        )
        begun = "opened" if self._port else "connecting to"
        self.get_logger().info(
            f"{begun} {plain(url)} for {spec.nodes} nodes: order {spec.order}, "
            f"{spec.bits} bits, a frame every {spec.frame_period_s * 1e3:g} ms"
        )
        self._heard = None
        self._rest.activate(self._driver)
        self._frames.start(config)
        self.pictures.start(config)
        self._driver.start(self._port)
        self._port = None  # the driver's now
        self._objects.start(self._driver)
        self._report = SkinReport(self.get_fully_qualified_name())
        return result

    @reported
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._stop_driver()
        return super().on_deactivate(state)

    @reported
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the configuration, so that every parameter can change."""
        self.release()
        return super().on_cleanup(state)

    @reported
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.release()
        return super().on_shutdown(state)

    @reported
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall back to unconfigured."""
        self.release()
        self._last_failure = f"internal error while {state.label}, see the log"
        return TransitionCallbackReturn.SUCCESS

    def release(self) -> None:
        """Stop the digitizer, join the driver's thread, keep tare and drift, close the port."""
        self._start_timer.cancel()
        self._stop_driver()
        if self._port is not None:
            self._port.close()
            self._port = None
        self._rest, self._declared.fixed = None, False
        self._mount.release()

    def destroy_node(self) -> None:
        """Join the driver's thread before its publishers go."""
        if hasattr(self, "_start_timer"):  # else its constructor has raised before it held anything
            self.release()
        super().destroy_node()

    def _start(self) -> None:
        """Configure and activate, unless somebody has taken the lifecycle into their own hands."""
        if self._rest is None and self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        if self._rest is None:
            self._start_timer.reset()  # which a transition that failed amid its work has cancelled
        else:
            self._start_timer.cancel()

    def _rest_path(self, url: str) -> tuple[Path | None, str]:
        """Tell where tare and drift are kept, or why they are not.

        Raises RestError for a folder of the user's that there cannot be.
        """
        folder, simulated = str(self._live["state_folder"]), url.lower().startswith(SIMULATION)
        try:
            return rest_path(folder, self.get_fully_qualified_name(), simulated), ""
        except RestError as error:  # a user without a home folder, as in a container
            if folder:
                raise
            return None, f"{error}; state_folder names a folder"

    def _stop_driver(self) -> None:
        if self._driver is not None and self._rest is not None:
            self._objects.stop()
            self._driver.stop()
            self._rest.deactivate()
            self._driver = None
        self.pictures.stop()
        self._frames.stop()

    # Publishing

    def _publish_info(self) -> None:
        assert self._rest is not None and self._rest.taxels is not None
        if self._heard is None:
            return  # _hear_source makes up for it
        self._frames.publish_info(self._rest.config, self._watch.source, self._rest.taxels)

    def _hear_source(self, info: Info) -> None:
        """The digitizer has described itself: who it is goes ahead of its frames.

        In the driver's thread; what was found on another kind of skin is in no frame of this one.
        """
        is_first, self._heard = self._heard is None, info
        warnings = self._watch.hear(info)
        if self._rest is not None:
            self._rest.hear(self._watch.source.measured_by != Origin.BOARD)
        for warning in warnings or ():
            self.get_logger().warning(plain(warning))
        if is_first or warnings is not None:
            self._publish_info()

    def _publish_diagnostics(self) -> None:
        if self._driver is None or self._rest is None:
            entries = self._report.inactive(self._last_failure)
        else:
            drivers = self.count_publishers(self._frames.topic)
            if (drivers > 1) != self._has_rivals:
                self._has_rivals = drivers > 1
                text = rivals(drivers) if self._has_rivals else "no other driver has this name now"
                self.get_logger().warning(text)
            latest = self._frames.latest
            entries = self._report.of(
                self._driver, self._watch, latest and latest[0], self._rest.tared, drivers
            )
            self._rest.tick()
        self._diagnostics_publisher.publish(report(self, entries))

    def _log_problem(self, problem: str | None) -> None:
        if problem in NOT_YET:
            self.get_logger().info(problem or "receiving frames")
        else:
            self.get_logger().error(problem)


@program("skin_driver")
def main() -> int:
    """Run the node until interrupted; returns the exit code."""
    return run_node(SkinNode)


if __name__ == "__main__":
    sys.exit(main())
