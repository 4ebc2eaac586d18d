# SPDX-License-Identifier: Apache-2.0

"""The firmware, built for the tests: its portable core as a library, its images by make."""

import ctypes
import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from emulated import Node
from test.support import firmware
from test.support.firmware import CORE, FIRMWARE, SANITIZE, SANITIZED, STRICT, Specimen, need, run
from test.support.rp2040_bench import USB, Bench, ramp

BUILD = FIRMWARE / "build"
COMPILERS = {"node": "avr-gcc", "rp2040": "arm-none-eabi-gcc", "replay-arm": "arm-none-eabi-gcc"}
"""Compilers that targets of firmware/Makefile need besides the host's."""


@pytest.fixture(scope="session")
def core(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """All of firmware/core and the tests' own C functions as a shared library, built once."""
    folder = tmp_path_factory.getbasetemp()
    if hasattr(request.config, "workerinput"):
        folder = folder.parent  # of all workers of this run
    library = folder / "libcore.so"
    with (folder / "libcore.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not library.exists():
            sources = [*sorted(CORE.glob("*.c")), *sorted(Path(__file__).parent.glob("shim_*.c"))]
            sanitize = SANITIZE if SANITIZED in os.environ else ()
            options = (*STRICT, "-O1", "-g", "-fPIC", "-shared", *sanitize)
            run(need("cc"), *options, *sources, "-o", library)
    return ctypes.CDLL(str(library))


@pytest.fixture(scope="session")
def built() -> Callable[[str], Path]:
    """Have make build a target of firmware/Makefile; returns firmware/build.

    Skips the test where the machine lacks what that takes.
    """

    def build(target: str) -> Path:
        need(COMPILERS.get(target, "cc"))
        if target == "sim" and not firmware.SIMAVR.exists():
            pytest.skip(
                "no libsimavr-dev on this machine; `make firmware-tools` tells how to get it"
            )
        BUILD.mkdir(exist_ok=True)
        # Tests run in several processes, which must not build the same file at once.
        run(need("flock"), BUILD / ".lock", need("make"), "-s", "-C", FIRMWARE, target)
        return BUILD

    return build


@pytest.fixture(scope="session")
def rp2040_image(built: Callable[[str], Path]) -> Path:
    """The RP2040's image; skips the test without its compiler or its emulator."""
    need("arm-none-eabi-gcc")
    need("node")
    if not (FIRMWARE / "sim" / "node_modules" / "rp2040js").is_dir():
        pytest.skip("no rp2040js; `make firmware-tools` gets it")
    return built("rp2040") / "rp2040" / "digitizer.bin"


@pytest.fixture
def bench(rp2040_image: Path) -> Iterator[Bench]:
    """The RP2040's image with a host at its USB, and a ramp at its ADC."""
    with Bench(rp2040_image, USB, ramp) as board:
        yield board


@pytest.fixture(scope="session")
def emulator(built: Callable[[str], Path]) -> None:
    """The library of emulated.py."""
    built("sim")


@pytest.fixture(scope="session")
def node_images(built: Callable[[str], Path], emulator: None) -> None:
    """The nodes' images, and what emulates them."""
    built("node")


@pytest.fixture(scope="session")
def specimen(tmp_path_factory: pytest.TempPathFactory, emulator: None) -> Specimen:
    """Compiles a program of specimens.c for an MCU; returns the node that runs it."""
    folder = tmp_path_factory.mktemp("avr")

    def build(name: str, mcu: str = "atmega328p", *options: str) -> Node:
        image = folder / f"{name}-{mcu}{''.join(options)}.elf"
        if not image.exists():
            warn = ("-std=gnu99", "-Wall", "-Wextra", "-Werror", "-Os")
            choice = (f"-mmcu={mcu}", f"-DSPECIMEN_{name}", *options)
            source = Path(__file__).with_name("specimens.c")
            run(need("avr-gcc"), *choice, *warn, source, "-o", image)
        return Node(image, mcu)

    return build


@pytest.fixture(scope="module")
def ros() -> Iterator[None]:
    """What ROS nodes in this process need; skips the test where there is no ROS."""
    pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
    from test.support.spinning import initialised

    with initialised():
        yield
