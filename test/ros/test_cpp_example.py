# SPDX-License-Identifier: Apache-2.0

"""The C++ of examples/cpp compiles and links against the built messages, and hears a driver.

Where the ROS libraries are PyPI's: their CMake files name libraries of the machine that built them,
and their copies of what they need, Python among it, are found by LD_LIBRARY_PATH and LD_PRELOAD.
"""

import math
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest
from geometry_msgs.msg import Vector3
from rclpy.node import Node

from tactile_cdma.msg import TactileContact, TactileContacts
from test.support.programs import run_program, started
from test.support.skin_client import running
from test.support.spinning import spinning
from test.support.waiting import wait_for

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("cpp example")]
SOURCES = Path(__file__).resolve().parents[2] / "examples" / "cpp"
WHEELS = """find_package(fastrtps REQUIRED)
set_target_properties(fastrtps PROPERTIES INTERFACE_LINK_LIBRARIES "")
"""
LINKER = "-Wl,--as-needed,--unresolved-symbols=ignore-in-shared-libs"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The subscriber, compiled and linked."""
    for tool in ("cmake", "c++"):
        if not shutil.which(tool):
            pytest.skip(f"{tool} is not installed")
    folder = tmp_path_factory.mktemp("cpp")
    options = []
    if Path(sys.prefix, "lib", "librcl.so").exists():
        (folder / "wheels.cmake").write_text(WHEELS)
        options = [
            f"-DCMAKE_PROJECT_tactile_cdma_cpp_example_INCLUDE={folder / 'wheels.cmake'}",
            f"-DCMAKE_EXE_LINKER_FLAGS={LINKER}",
            f"-DCMAKE_PREFIX_PATH={sys.prefix}",
        ]
    path = f"{Path(sys.prefix, 'bin')}{os.pathsep}{os.environ['PATH']}"
    build = ["cmake", "-S", SOURCES, "-B", folder, f"-DPython3_EXECUTABLE={sys.executable}"]
    for command in ([*build, "-DCMAKE_CXX_FLAGS=-Werror", *options], ["cmake", "--build", folder]):
        done = run_program(*command, env=os.environ | {"PATH": path}, timeout=600)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return folder / "subscribe"


@contextmanager
def subscribed(program: Path) -> Iterator[IO[str]]:
    """What the program prints; then it ends at once, as it is told to."""
    libraries = [Path(sys.prefix, "lib"), *Path(sysconfig.get_path("purelib")).glob("*.libs")]
    python = Path(*map(str, sysconfig.get_config_vars("LIBDIR", "INSTSONAME")))
    found = [*map(str, libraries), os.environ.get("LD_LIBRARY_PATH", "")]
    env = os.environ | {"LD_LIBRARY_PATH": os.pathsep.join(found)}
    if python.suffix != ".a":
        env["LD_PRELOAD"] = str(python)
    with started([program], stdout=subprocess.PIPE, env=env) as process:
        assert process.stdout is not None
        yield process.stdout
        process.terminate()
        assert process.wait(60) == 0


def test_it_hears_a_driver(program: Path) -> None:
    with running(port="sim://?scene=all&seed=3&threshold=0"), subscribed(program) as said:
        heard = [said.readline() for _ in range(40)]
    forces_n = re.findall(r"frame=\d+ force_n=([\d.]+) m_s=-0\.0200", "".join(heard))
    assert len(forces_n) > 20 and max(map(float, forces_n)) > 1.0, heard


FORCE, UP = Vector3(z=-1.5), Vector3(z=1.0)
SURE = {"taxels_in_service": 16, "taxels_valid": 16}
CASES = [
    ({"untouched": True}, None, 0.0, "force_n=0.0000 m_s=0.0100"),
    ({"touched": True}, {}, 0.0, "force_n=1.5000 m_s=0.0025"),
    ({"touched": True}, {}, 5.0, "unknown=old"),
    ({"touched": True}, {}, -5.0, "unknown=old"),
    ({}, None, 0.0, "unknown=blind"),
    ({"touched": True, "taxels_valid": 15}, {}, 0.0, "unknown=blind in part"),
    ({"touched": True}, {"lower_bound": True}, 0.0, "unknown=beyond"),
    ({"touched": True}, {"force": Vector3(z=math.nan)}, 0.0, "unknown=not a number"),
]


def test_a_force_that_is_not_known_stops_the_loop(program: Path) -> None:
    """Also where something presses that the skin does not feel, or felt long ago."""
    node = Node("impostor")
    with spinning([node]), subscribed(program) as said:
        publisher = node.create_publisher(TactileContacts, "/skin/contacts", 10)
        wait_for(publisher.get_subscription_count)
        time.sleep(0.5)
        for number, (claims, contact, age_s, expected) in enumerate(CASES):
            message = TactileContacts(sequence=number, **(SURE | claims))
            if contact is not None:
                message.contacts = [TactileContact(**({"force": FORCE, "normal": UP} | contact))]
            line = ""
            while not line.startswith(f"frame={number} "):
                now_ns = time.time_ns() - round(age_s * 1e9)
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
                publisher.publish(message)
                line = said.readline()
            assert expected in line, line
            assert ("unknown" in line) == line.endswith("m_s=0.0000\n")
