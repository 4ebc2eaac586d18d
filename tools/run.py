# SPDX-License-Identifier: Apache-2.0

"""Runs the driver, or those of a body, and the viewer until the viewer ends: `make run`."""

from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the imports: no traceback

import argparse
import ctypes
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory
from typing import IO

from tactile_cdma.base.errors import TactileError
from tactile_cdma.base.interrupt import stop_event
from tactile_cdma.base.named_file import existing
from tactile_cdma.config.body_file import LOCALHOST, RANGE, Patch, read_body
from tactile_cdma.config.parameters import unknown

CHECKOUT = Path(__file__).resolve().parent.parent
PARAMS = CHECKOUT / "config" / "skin.yaml"
WIRED_PARAMS = CHECKOUT / "config" / "wired_skin.yaml"
SIMULATION = "sim://"
EMULATOR = CHECKOUT / "firmware" / "sim" / "serve.py"
LOG = CHECKOUT / "log" / "driver.log"
SECONDS_WITHOUT_TERMINAL = 10.0
PATIENCE_S = 5.0
USAGE = (
    "make run|view [PORT=url] [PARAMS=file | PATCHES=file] [FIRMWARE=1] [SECONDS=n (run)] "
    "[WEB=1 (view)]"
)


def main() -> int:
    """Run all; the exit code is the viewer's, or 1 if the drivers ended by themselves."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    parser = argparse.ArgumentParser(
        prog="make run", usage=USAGE, description=__doc__, allow_abbrev=False
    )
    # The Makefile passes variables that were not set as empty texts.
    parser.add_argument("--port", default="", help="default: the simulated skin")
    parser.add_argument("--params", default="", help=f"default: {PARAMS.relative_to(CHECKOUT)}")
    parser.add_argument("--seconds", type=_seconds, default=0.0)
    parser.add_argument("--firmware", default="", help="1: the emulated skin is the port")
    parser.add_argument("--patches", default="", help="body file: many patches")
    parser.add_argument("--rerun", choices=("", "window", "web"), help="Rerun is the viewer")
    arguments, others = parser.parse_known_args()
    if others:
        parser.error(unknown(others[0].lstrip("-").partition("=")[0], vars(arguments), "argument"))
    firmware = arguments.firmware not in ("", "0")
    if firmware and arguments.port:
        parser.error(f"FIRMWARE=1 makes a port of its own; leave PORT={arguments.port} out")
    if arguments.patches and (firmware or arguments.port or arguments.params):
        parser.error("PATCHES names a body file, which says ports and parameters itself")
    try:
        params = existing(Path(arguments.params or (WIRED_PARAMS if firmware else PARAMS)))
    except TactileError as error:
        parser.error(str(error))
    # A parameter file of the user's own names the port, unless one is given besides.
    port = arguments.port or ("" if arguments.params else SIMULATION)
    terminal = sys.stdin.isatty() and sys.stdout.isatty()
    seconds = arguments.seconds or (0.0 if terminal else SECONDS_WITHOUT_TERMINAL)

    if find_spec("rclpy") is None:
        if arguments.patches or arguments.rerun or firmware:
            parser.error("without ROS only PORT, PARAMS and SECONDS: the rest shows topics")
        watch = [sys.executable, str(CHECKOUT / "tools" / "watch.py"), "--params", str(params)]
        os.execv(sys.executable, [*watch, "--port", port, "--seconds", f"{seconds:g}"])  # noqa: S606
    os.environ.setdefault(RANGE, LOCALHOST)
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    rerun = script("skin_rerun", *["--web"] * (arguments.rerun == "web")) if arguments.rerun else []
    shown_for = ["--seconds", f"{seconds:g}"] if seconds else []
    quiet = seconds == 0.0
    if arguments.patches:
        try:
            commands = body_commands(Path(arguments.patches))
        except TactileError as error:
            parser.error(str(error))
        viewer = rerun or script("skin_body_view", *shown_for)
        return run(commands, viewer, quiet=bool(rerun))
    viewer = rerun or script("skin_view", *shown_for)
    if not firmware:
        return run([driver_command(params, port)], viewer, quiet)
    with emulated_skin(params) as port:
        return run([driver_command(params, port)], viewer, quiet)


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
    """Read a time span; nothing means none."""
    try:
        seconds = float(text or 0)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < math.inf:
        raise argparse.ArgumentTypeError(f"SECONDS={text} is not a number of seconds")
    return seconds


def driver_command(params: Path, port: str) -> list[str]:
    """Return the command of the driver node."""
    parameters = {"port": port} if port else {}
    return node_command("skin_driver", parameters, "--params-file", str(params))


def body_commands(path: Path) -> list[list[str]]:
    """Return those of a body's drivers, and of its own node. Raises BodyError for a wrong file."""
    commands = []
    for patches in read_body(path).processes():
        names = ",".join(patch.name for patch in patches)
        together = script("skin_patches", str(path), "--only", names)
        commands.append(patch_command(patches[0]) if len(patches) == 1 else together)
    return [*commands, node_command("skin_body", {"body_file": str(path)})]


def patch_command(patch: Patch) -> list[str]:
    """Return the command of one patch's driver."""
    file = ["--params-file", str(patch.params_file)] if patch.params_file else []
    return node_command("skin_driver", patch.parameters, "-r", f"__ns:={patch.namespace}", *file)


def script(name: str, *words: str) -> list[str]:
    """Return the command of a script of this checkout."""
    return [sys.executable, str(CHECKOUT / "scripts" / name), *words]


def node_command(name: str, parameters: Mapping[str, object], *ros_arguments: str) -> list[str]:
    """Return the command of a node."""
    command = script(name, "--ros-args", *ros_arguments)
    for name, value in parameters.items():
        # Quoted, for a text that YAML would read as something else.
        command += ["-p", f"{name}:={json.dumps(value)}"]
    return command


def run(commands: Sequence[list[str]], viewer_command: list[str], quiet: bool) -> int:
    """Run until the viewer ends. quiet: the nodes' log must not disturb the viewer's picture."""
    with stop_event(None) as stop, _log_file() as log:
        shown = log if quiet else None
        # In a session of their own, Ctrl-C does not reach nodes before the viewer has ended.
        nodes = [
            subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=shown,
                stderr=shown,
                start_new_session=True,
                preexec_fn=_end_with_parent,
            )
            for command in commands
        ]
        viewer = subprocess.Popen(viewer_command, preexec_fn=_end_with_parent)

        def goes_on() -> bool:
            return viewer.poll() is None and not stop.is_set()

        try:
            while goes_on() and any(node.poll() is None for node in nodes):
                time.sleep(0.05)
            nodes_failed = goes_on()
            # Ctrl-C has reached the viewer through the terminal; another one would disturb its end.
            is_told = stop.is_set() and sys.stdin.isatty()
            code = _end(viewer, grace_s=PATIENCE_S if is_told else 0.5)
        finally:
            for node in nodes:  # all at once
                if node.poll() is None:
                    node.send_signal(signal.SIGINT)
            for node in nodes:
                _end(node, grace_s=PATIENCE_S)
    if nodes_failed:
        codes = ", ".join(str(node.returncode) for node in nodes)
        print(f"the driver ended by itself, exit code {codes}", file=sys.stderr)
        if quiet:
            print("\n".join(Path(log.name).read_text().splitlines()[-15:]), file=sys.stderr)
        return 1
    return code if code >= 0 else 128 - code


def _log_file() -> IO[str]:
    """Open a file for the driver's log: LOG, or one of its own in another user's checkout."""
    try:
        LOG.parent.mkdir(exist_ok=True)
        return LOG.open("w")
    except OSError:
        return NamedTemporaryFile("w", prefix="driver.", suffix=".log", delete=False)


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
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
