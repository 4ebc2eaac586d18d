# SPDX-License-Identifier: Apache-2.0

"""What one ordinary frame passes on its way from a tty to a TactileArray, as JSON.

python -m test.support.traced_frame KERNEL TTY: runs a driver node on this kernel, which was built
with --coverage and the two functions of COVERAGE, and a subscriber. The functions in Python are
those that most frames call; those in C are left in KERNEL's .gcda files.
"""

import ctypes
import json
import os
import sys
import time
from collections import Counter
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import FrameType
from typing import Any

COVERAGE = """
void __gcov_reset(void);
void __gcov_dump(void);
__attribute__((visibility("default"))) void begin_count(void) { __gcov_reset(); }
__attribute__((visibility("default"))) void end_count(void) { __gcov_dump(); }
"""
WARM, LEARNT, MOST = 150, 60, 2000
"""Frames before it is looked at what they call; those of which most call the same; most in all."""


def use_kernel(path: Path) -> None:
    """Have the package use this kernel."""
    name = "tactile_cdma._kernel"
    spec = spec_from_file_location(name, path, loader=ExtensionFileLoader(name, str(path)))
    assert spec is not None and spec.loader is not None
    sys.modules[name] = module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])


def main() -> int:
    """Trace frames until one is like most others; returns the exit code."""
    path, tty = Path(sys.argv[1]), sys.argv[2]
    use_kernel(path)
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.parameter import Parameter
    from rclpy.qos import qos_profile_sensor_data

    from tactile_cdma.driver import driver
    from tactile_cdma.msg import TactileArray
    from tactile_cdma.ros.driver.node import SkinNode

    kernel, package = ctypes.CDLL(str(path)), Path(driver.__file__).parents[1]
    called: set[tuple[str, str]] = set()
    usual: Counter[frozenset[tuple[str, str]]] = Counter()
    steps, found = 0, False

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(str(package)):
            file = Path(code.co_filename).relative_to(package)
            called.add((str(file), code.co_qualname))

    plain = driver.Driver._next

    def traced(self: driver.Driver, *arguments: Any) -> Any:
        nonlocal steps, found
        steps += 1
        if steps < WARM or found:
            return plain(self, *arguments)
        called.clear()
        began_s = time.monotonic()
        kernel.begin_count()
        sys.setprofile(note)
        try:
            frame, read_s = plain(self, *arguments)
        finally:
            sys.setprofile(None)
        usual[frozenset(called)] += 1
        waited = frame is not None and read_s > began_s  # its bytes had not come before
        if steps > WARM + LEARNT and usual.most_common(1)[0][0] == called and waited:
            kernel.end_count()
            found = True
        return frame, read_s

    driver.Driver._next = traced  # type: ignore[method-assign]
    rclpy.init()
    node = SkinNode(parameter_overrides=[Parameter("port", value=tty)])
    node.create_subscription(TactileArray, "~/tactile", lambda _: None, qos_profile_sensor_data)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while steps < WARM:
        executor.spin_once(timeout_sec=0.1)
    while not found and steps < MOST:  # timers would be counted as the frame's
        time.sleep(0.01)
    if not found:
        print("no frame was like most others", file=sys.stderr)
        return 1
    json.dump(sorted(usual.most_common(1)[0][0]), sys.stdout)
    sys.stdout.flush()
    os._exit(0)  # without a second report of what was counted


if __name__ == "__main__":
    sys.exit(main())
