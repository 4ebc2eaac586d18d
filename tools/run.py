"""Runs the driver and the viewer until the viewer ends: `make run`."""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

CHECKOUT = Path(__file__).resolve().parent.parent
PARAMS = CHECKOUT / "config" / "skin.yaml"
WIRED_PARAMS = CHECKOUT / "config" / "wired_skin.yaml"
SIMULATION = "sim://"
EMULATOR = CHECKOUT / "firmware" / "sim" / "serve.py"
LOG = CHECKOUT / "log" / "driver.log"
SECONDS_WITHOUT_TERMINAL = 10.0
PATIENCE_S = 5.0


def main() -> int:
    """Run both; the exit code is the viewer's, or 1 if the driver ended by itself."""
    parser = argparse.ArgumentParser(description=__doc__)
    # The Makefile passes variables that were not set as empty texts.
    parser.add_argument("--port", default="", help="default: the simulated skin")
    parser.add_argument("--params", default="", help=f"default: {PARAMS.relative_to(CHECKOUT)}")
    parser.add_argument("--seconds", type=_seconds, default=0.0)
    parser.add_argument("--firmware", default="", help="1: the emulated skin is the port")
    arguments = parser.parse_args()
    firmware = arguments.firmware not in ("", "0")
    if firmware and arguments.port:
        parser.error(f"FIRMWARE=1 makes a port of its own; leave PORT={arguments.port} out")
    params = Path(arguments.params or (WIRED_PARAMS if firmware else PARAMS))
    if not params.is_file():
        parser.error(f"no parameter file {params}")
    # A parameter file of the user's own names the port, unless one is given besides.
    port = arguments.port or ("" if arguments.params else SIMULATION)
    terminal = sys.stdin.isatty() and sys.stdout.isatty()
    seconds = arguments.seconds or (0.0 if terminal else SECONDS_WITHOUT_TERMINAL)

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    viewer, quiet = viewer_command(seconds), seconds == 0.0
    if not firmware:
        return run(driver_command(params, port), viewer, quiet)
    with emulated_skin(params) as port:
        return run(driver_command(params, port), viewer, quiet)


@contextmanager
def emulated_skin(params: Path) -> Iterator[str]:
    """Run the firmware in its emulators; yields the port that it is served on."""
    with TemporaryDirectory(prefix="skin-") as folder:
        link = str(Path(folder) / "tty")
        server = subprocess.Popen(
            [sys.executable, str(EMULATOR), "--params", str(params), "--link", link],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )
        try:
            assert server.stdout is not None
            if not server.stdout.readline():  # what it says when it is ready
                raise SystemExit(1)  # it has said why not
            yield link
        finally:
            _end(server)


def _seconds(text: str) -> float:
    """A time span; nothing means none."""
    seconds = float(text or 0)
    if seconds < 0:
        raise ValueError
    return seconds


def driver_command(params: Path, port: str) -> list[str]:
    """Return the command of the driver node."""
    command = [sys.executable, str(CHECKOUT / "scripts" / "skin_driver"), "--ros-args"]
    command += ["--params-file", str(params)]
    # Quoted, for a text that YAML would read as something else.
    return command + (["-p", f"port:={json.dumps(port)}"] if port else [])


def viewer_command(seconds: float) -> list[str]:
    """Return the command of the viewer."""
    command = [sys.executable, "-m", "tactile_cdma.ros.view"]
    return command + (["--seconds", f"{seconds:g}"] if seconds else [])


def run(driver_command: list[str], viewer_command: list[str], quiet: bool) -> int:
    """Run until the viewer ends. quiet: the driver's log must not disturb the viewer's picture."""
    asked_to_end = False

    def remember(signum: int, frame: FrameType | None) -> None:
        nonlocal asked_to_end
        asked_to_end = True

    for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(signum, remember)
    LOG.parent.mkdir(exist_ok=True)
    with LOG.open("w") as log:
        # In a session of its own, Ctrl-C does not reach the driver before the viewer has ended.
        driver = subprocess.Popen(
            driver_command,
            stdin=subprocess.DEVNULL,
            stdout=log if quiet else None,
            stderr=log if quiet else None,
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )
    viewer = subprocess.Popen(viewer_command, preexec_fn=_end_with_parent)
    try:
        while viewer.poll() is None and driver.poll() is None and not asked_to_end:
            time.sleep(0.05)
        driver_failed = viewer.poll() is None and not asked_to_end
        # Ctrl-C has reached the viewer through the terminal; a second one would disturb its end.
        code = _end(viewer, grace_s=0.5)
    finally:
        _end(driver)
    if driver_failed:
        print(f"the driver ended by itself, exit code {driver.returncode}", file=sys.stderr)
        if quiet:
            print("\n".join(LOG.read_text().splitlines()[-15:]), file=sys.stderr)
        return 1
    return code if code >= 0 else 128 - code


def _end(process: subprocess.Popen[bytes], grace_s: float = 0.0) -> int:
    """Wait for a process to end, then ask it to, ever less politely; return its exit code."""
    for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        try:
            return process.wait(grace_s)
        except subprocess.TimeoutExpired:
            process.send_signal(signum)
            grace_s = PATIENCE_S
    return process.wait()


def _end_with_parent() -> None:
    """Have Linux end this process if run.py is killed."""
    if sys.platform == "linux":
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
