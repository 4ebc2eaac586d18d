# SPDX-License-Identifier: Apache-2.0

"""Checks whether this computer is set up for the driver. Standard library only."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from importlib import metadata
from pathlib import Path

from ..base.errors import KernelError
from ..base.named_file import CHECKOUT, shipped
from .report import Check, Grade, ok, problem, warning

RULES = "60-tactile-cdma.rules"
RULES_FOLDERS = ("etc/udev/rules.d", "run/udev/rules.d", "usr/lib/udev/rules.d", "lib/udev/rules.d")
LEAST_SHARED_BYTES = 32 << 20
"""Free in /dev/shm. Chosen: a ROS node takes 1 MB or more, and with none left loses data."""
PORTS = "fast*_port*[0-9]"
"""Names of the segments in which Fast DDS receives messages, one per DDS port."""
UNFINISHED_S = 2.0
"""Age, s, at which a segment should have its size: it gets it microseconds after its name."""
ROS_TIMEOUT_S = 60.0
"""Time limit for the checks of ROS 2, s; chosen: several times what a slow computer takes."""

_run = partial(subprocess.run, capture_output=True, text=True)


def installation() -> Iterator[Check]:
    """Run all checks, the cheap ones first."""
    yield python_version()
    yield from packages()
    yield compiled_kernel()
    yield from port_access()
    root = Path("/")
    yield from udev_rule(root)
    yield from port_takers(root)
    yield from shared_memory(root / "dev/shm")
    yield from clock()
    yield from ros()


def python_version() -> Check:
    """Check the interpreter against requires-python."""
    needed, present = "", platform.python_version()
    if (path := shipped("pyproject.toml")) is not None:
        needed = str(tomllib.loads(path.read_text("utf-8"))["project"]["requires-python"])
    with suppress(metadata.PackageNotFoundError, KeyError):
        needed = needed or str(metadata.metadata("tactile_cdma")["Requires-Python"])
    match = re.fullmatch(r">=(\d+)\.(\d+)", needed)
    if match and sys.version_info < tuple(map(int, match.groups())):
        return problem("Python", f"{present}, but {needed} is needed: use a newer one")
    return ok("Python", f"{present} ({sys.executable})")


def packages() -> Iterator[Check]:
    """Check what the core imports against requirements.txt."""
    try:
        from packaging.requirements import InvalidRequirement, Requirement
    except ImportError:
        yield problem("packaging", "missing: pip install packaging (or apt: python3-packaging)")
        return
    lines = requirements()
    if not lines:
        yield warning("packages", "requirements.txt was not found: versions are not checked")
    for text in lines:
        try:
            needed = Requirement(text)
        except InvalidRequirement:
            yield warning("packages", f"{text!r} in requirements.txt is not a requirement")
            continue
        try:
            present = metadata.version(needed.name)
        except metadata.PackageNotFoundError:
            yield problem(needed.name, f"missing: pip install '{text}', or rosdep install")
            continue
        if needed.specifier.contains(present, prereleases=True):
            yield ok(needed.name, present)
        else:
            yield warning(
                needed.name,
                f"{present} is outside of the tested {needed.specifier}: pip install '{text}'",
            )


def compiled_kernel() -> Check:
    """Check that what does the arithmetic of every frame was built, and loads."""
    try:
        from ..base import kernel
    except KernelError as error:
        return problem("kernel", str(error))
    return ok("kernel", f"{kernel.lib.transform_lanes()} values at once")


def requirements() -> list[str]:
    """Return the core's requirements: from the checkout, or from the colcon or pip installation."""
    path = shipped("requirements.txt")
    if path is not None:
        lines = (line.split("#")[0].strip() for line in path.read_text("utf-8").splitlines())
        return [line for line in lines if line]
    try:
        return [line for line in metadata.requires("tactile_cdma") or [] if ";" not in line]
    except metadata.PackageNotFoundError:
        return []


def port_access() -> Iterator[Check]:
    """Check whether this user may open serial ports; nothing where all users may, on Windows."""
    try:
        import grp
        import pwd
    except ImportError:
        return
    devices = [*Path("/dev").glob("ttyACM*"), *Path("/dev").glob("ttyUSB*")]
    closed = [device for device in devices if not os.access(device, os.R_OK | os.W_OK)]
    if devices and not closed:
        yield ok("serial ports", f"{', '.join(map(str, devices))} may be opened")
        return
    if os.geteuid() == 0:
        yield ok("serial ports", "root may open all")
        return
    try:
        name = closed[0].group() if closed else "dialout"
        group = grp.getgrnam(name)
    except (KeyError, OSError):  # OSError: unplugged just now
        return
    try:
        user = pwd.getpwuid(os.getuid()).pw_name
        remedy = f"sudo usermod -aG {name} {user}, then log in again"
    except KeyError:
        user = f"user {os.getuid()}"
        remedy = f"a container takes --group-add {group.gr_gid}"
    if group.gr_gid in {*os.getgroups(), os.getegid()}:
        yield ok("serial ports", f"{user} is in the group {name}")
    elif user in group.gr_mem:
        yield problem("serial ports", f"{user} is in the group {name} only after the next login")
    else:
        text = f"{user} is not in the group {name} and may not open them: {remedy}"
        yield (problem if closed else warning)("serial ports", text)


def udev_rule(root: Path) -> Iterator[Check]:
    """Check the udev rule for stable names; nothing without udev, as in a container."""
    if not (root / "run/udev/control").exists():
        return
    ours, path = shipped(f"config/{RULES}"), _rule(root)
    if path is None:
        yield warning(
            "udev rule",
            "not installed, boards have no /dev/tactile/… names: "
            f"sudo cp {ours or RULES} /etc/udev/rules.d/, then sudo udevadm control --reload",
        )
    elif ours is not None and path.read_bytes() != ours.read_bytes():
        yield warning("udev rule", f"{path} is not that of this version: copy {ours} there")
    else:
        yield ok("udev rule", str(path))


def _rule(root: Path) -> Path | None:
    paths = (root / folder / RULES for folder in RULES_FOLDERS)
    return next(filter(Path.is_file, paths), None)


def port_takers(root: Path) -> Iterator[Check]:
    """Check for programs that open or take away new ports: of modems, and of Braille displays."""
    running = set[str]()
    for comm in (root / "proc").glob("[0-9]*/comm"):
        with suppress(OSError):  # ended meanwhile
            running.add(comm.read_text(encoding="utf-8", errors="replace").strip())
    if "ModemManager" in running and not _rule(root):
        yield warning(
            "ModemManager",
            "it keeps boards busy for seconds after they are plugged in: install the udev "
            "rule, or remove it (sudo apt remove modemmanager)",
        )
    rules = [rule for folder in RULES_FOLDERS for rule in (root / folder).glob("*brltty*.rules")]
    if "brltty" in running or rules:
        yield warning(
            "brltty",
            "it takes UART adapters (CH340, CP210x, FTDI) for Braille displays, and their "
            "/dev/ttyUSB… away: remove it (sudo apt remove brltty) where there is no such display",
        )


def shared_memory(folder: Path) -> Iterator[Check]:
    """Check the room for Fast DDS, which uses shared memory; containers get 64 MB."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        return
    text = f"{free >> 20} MB free in {folder}"
    if unfinished := [str(path) for path in sorted(folder.glob(PORTS)) if _is_unfinished(path)]:
        yield problem(
            "shared memory",
            f"{', '.join(unfinished)}: begun and left by a program that ended, or had no room; ROS "
            "programs that meet it hang: remove it, then restart them",
        )
    elif free < LEAST_SHARED_BYTES:
        yield warning(
            "shared memory",
            f"{text}: remove leftovers ({folder}/fastrtps_*) while no ROS program runs; "
            "containers take --shm-size=512m",
        )
    else:
        yield ok("shared memory", text)


def _is_unfinished(path: Path) -> bool:
    """Tell whether a segment has no size, although it is older than it takes to get one."""
    try:
        seen = path.stat()
    except OSError:  # removed just now
        return False
    return seen.st_size == 0 and time.time() - seen.st_mtime > UNFINISHED_S


def clock() -> Iterator[Check]:
    """Check that the clock is synchronized, so that stamps of several computers can be compared."""
    command = ["timedatectl", "show", "--property=NTPSynchronized", "--value"]
    try:
        answer = _run(command, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):  # no systemd: then it is not known
        return
    if answer == "yes":
        yield ok("clock", "synchronized")
    elif answer == "no":
        text = "not synchronized: with several computers stamps differ (install chrony)"
        yield warning("clock", text)


def ros() -> Iterator[Check]:
    """Run the checks of tactile_cdma.ros.doctor in another process, as ROS may crash or hang."""
    path = os.pathsep.join(filter(None, (str(CHECKOUT), os.environ.get("PYTHONPATH"))))
    try:
        command = [sys.executable, "-m", "tactile_cdma.ros.doctor"]
        run = _run(command, timeout=ROS_TIMEOUT_S, env={**os.environ, "PYTHONPATH": path})
    except subprocess.TimeoutExpired:
        yield problem(
            "ROS 2",
            f"no answer within {ROS_TIMEOUT_S:g} s: the middleware hangs; is the network up, and "
            "does a VPN or a firewall hold back UDP?",
        )
        return
    for entry in run.stdout.splitlines():  # a check as JSON, or what the middleware says
        with suppress(ValueError, KeyError, TypeError):
            values = json.loads(entry)
            yield Check(Grade(values["verdict"]), values["subject"], values["text"])
    if run.returncode:
        last = run.stderr.strip().splitlines()[-1:] or [f"exit code {run.returncode}"]
        yield problem("ROS 2", f"its examination failed: {last[0]}")
