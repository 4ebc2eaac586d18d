# SPDX-License-Identifier: Apache-2.0

"""The pytest plugin that comes with this package; docs/programs.md shows its use.

Its fixtures are simulated_skin and simulated_driver. They take parameters of the skin, and sim for
more options of its URL, from a marker:

    @pytest.mark.simulated_skin(nodes=24, frame_period_ms=16.0, sim="dead=3,4")
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from ..ros.client import SkinClient, Touch
    from ..sim.indenters import Indenter
    from ..skin import Skin

MARKER = "simulated_skin"
PORT = "sim://?scene=external&speed=0&threshold=0"
"""A skin that a test presses, frame by frame; every node speaks in every frame."""
START_S = 120.0
"""Longest wait for a driver's start, s; chosen for a busy computer."""
ASK_S, LATE_S = 0.5, 5.0
"""Interval of the first questions, s, and longest wait for the answers to all of them; chosen."""


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marker."""
    config.addinivalue_line(
        "markers", f"{MARKER}(sim='', **parameters): the skin of simulated_skin, simulated_driver"
    )


@pytest.fixture
def simulated_skin(request: pytest.FixtureRequest) -> Iterator[Skin]:
    """Open a Skin that a test presses: frame = simulated_skin.step(Sphere(…)); without ROS."""
    from ..skin import Skin

    with Skin(contacts=True, **_parameters(request)) as skin:
        yield skin


@pytest.fixture
def simulated_driver(request: pytest.FixtureRequest) -> Iterator[SimulatedDriver]:
    """Start a node, /skin, in a process of its own, that a test presses: simulated_driver.step().

    It is in the ROS domain of the environment, and so are the nodes that are to be tested.
    """
    with ExitStack() as ends:
        yield SimulatedDriver(_parameters(request), ends)


class SimulatedDriver:
    """A driver of a simulated skin, and a client of it.

    client: a SkinClient; step() has it receive what is new.
    """

    client: SkinClient

    def __init__(self, parameters: dict[str, Any], ends: ExitStack) -> None:
        """ends: ends everything, when it is closed.

        Raises what Skin does for wrong parameters, RuntimeError if the driver ends, TimeoutError.
        """
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        from ..msg import SimObjects
        from ..ros.client import SkinClient
        from ..skin import Skin

        known = Skin(**parameters).parameters  # a driver would only wait for better ones
        folder = ends.enter_context(tempfile.TemporaryDirectory())
        # Quoted, for a text that YAML would read as something else.
        given = {"state_folder": folder, **known}.items()
        words = [word for name, value in given for word in ("-p", f"{name}:={json.dumps(value)}")]
        command = [sys.executable, "-m", "tactile_cdma.ros.driver.node", "--ros-args", *words]
        self.process = subprocess.Popen(command)
        ends.callback(self._end)
        context = rclpy.Context()
        context.init()
        ends.callback(context.try_shutdown)
        node = Node("simulated_driver_client", context=context)
        ends.callback(node.destroy_node)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        ends.callback(self._executor.shutdown)
        self._touches: list[Touch] = []
        self.client = SkinClient(node, on_touch=self._touches.append, silent_after_s=START_S)
        self._objects = node.create_publisher(SimObjects, "/skin/sim/objects", 10)
        self._spin_until(
            lambda: (
                node.count_publishers("/skin/contacts") and self._objects.get_subscription_count()
            ),
            START_S,
        )
        asked, next_s = 0, 0.0

        def heard() -> bool:
            """Tell whether a frame came; asks again, as the first ones may pass unheard."""
            nonlocal asked, next_s
            if time.monotonic() > next_s:
                asked, next_s = asked + 1, time.monotonic() + ASK_S
                self._ask(())
            return bool(self._touches)

        self._spin_until(heard, START_S)
        with suppress(TimeoutError):  # one that comes late would be taken for a step's answer
            self._spin_until(lambda: len(self._touches) >= asked, LATE_S)

    def step(self, *objects: Indenter, timeout_s: float = 5.0) -> Touch:
        """Let these objects, and no others, touch the skin for one frame; returns what it feels."""
        from ..config.python_arguments import seconds

        timeout_s = seconds("timeout_s", timeout_s)
        self._touches.clear()
        self._ask(objects)
        self._spin_until(lambda: self._touches, timeout_s)
        return self._touches[-1]

    def _ask(self, objects: tuple[Indenter, ...]) -> None:
        from ..ros.driver.objects import sim_objects

        self._objects.publish(sim_objects(objects))

    def _spin_until(self, condition: Callable[[], object], timeout_s: float) -> None:
        end_s = time.monotonic() + timeout_s
        while not condition():
            if self.process.poll() is not None:
                raise RuntimeError("the driver has ended; what it says is above")
            if time.monotonic() > end_s:
                raise TimeoutError(f"no answer of the driver within {timeout_s:g} s")
            self._executor.spin_once(0.05)

    def _end(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _parameters(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Return the parameters of the skin that a test's marker asks for, its port among them."""
    from ..base.errors import ParameterError
    from ..config.python_arguments import argument, parameters_of

    marker = request.node.get_closest_marker(MARKER)
    parameters = dict(marker.kwargs) if marker else {}
    sim = argument("sim", parameters.pop("sim", ""), "")
    if "port" in parameters:
        raise ParameterError(f"port is the fixture's, {PORT}; give more options of it as sim")
    return {"port": f"{PORT}&{sim}".strip("&")} | parameters_of(parameters)
