# SPDX-License-Identifier: Apache-2.0

"""A body on three hosts: a patch on each of two, the body's node on the third, witnesses on all."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from subprocess import DEVNULL, PIPE

from .judge import BODY_CONTACTS, CONTACTS, Heard
from .network import Host, Network

ROOT = Path(__file__).resolve().parents[2]
LEFT, RIGHT, BRAIN = "left", "right", "brain"
SIDES = (LEFT, RIGHT)
PATCHES = {name: f"/{name}/skin" for name in SIDES}
SCENES = {LEFT: "scene=idle", RIGHT: "scene=press"}
"""Nothing touches the left patch; a finger is on the right one for 2 s, and off for 2 s."""
PERIOD_S = 0.04
"""Period of frames, s: 25 a second."""
STALE_AFTER_S = 1.0
"""The body's default."""
_TURN_S = 0.05
CLOCK_OFFSET = Path(__file__).with_name("clock_offset.c")


class WrongClock:
    """This computer's wall clock plus an offset, which is 0 at first.

    environment: of the processes that have it.
    """

    def __init__(self, folder: Path, name: str) -> None:
        """Raises CalledProcessError or OSError without a C compiler. name: of its file."""
        library = folder / "clock_offset.so"
        if not library.exists():
            command = ["cc", "-O2", "-shared", "-fPIC", "-o", str(library), str(CLOCK_OFFSET)]
            subprocess.run(command, check=True)
        self._path = folder / f"clock_{name}"
        self._path.write_bytes(bytes(8))
        self.environment = {"LD_PRELOAD": str(library), "CLOCK_OFFSET_FILE": str(self._path)}

    def set(self, offset_s: float) -> None:
        """Change the offset, at once for all its processes."""
        with self._path.open("r+b") as file:  # they have mapped it: not a new file
            file.write(round(offset_s * 1e9).to_bytes(8, sys.byteorder, signed=True))


class Rig:
    """Use as a context manager.

    patience_s: what takes longer hangs. heard: all that arrived on the third host. truth: what the
    patches' own hosts heard of them. processes: the programs on the hosts. clocks: those of the
    hosts.
    """

    def __init__(
        self,
        network: Network,
        folder: Path,
        patience_s: float,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """environment: of ROS, besides the defaults."""
        self.network, self.patience_s, self.hangs = network, patience_s, 0
        self.heard: list[Heard] = []
        self.truth: list[Heard] = []
        self._folder = folder
        self._environment = {
            **os.environ,
            "ROS_DOMAIN_ID": "0",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "ROS_HOME": str(folder / "ros"),
            **(environment or {}),
        }
        self.clocks = {host: WrongClock(folder, host) for host in network.hosts}
        self.processes: list[subprocess.Popen[str]] = []
        self._stack = ExitStack()

    def __enter__(self) -> Rig:
        with ExitStack() as stack:
            self._log = stack.enter_context((self._folder / "nodes.log").open("a"))
            for side in SIDES:
                self._starts(stack, side, "skin_driver", "-r", f"__ns:=/{side}", *_values(side))
                self._listens(stack, side, self.truth, PATCHES[side])
            patches = f"patches:=[{','.join(PATCHES.values())}]"
            self._starts(stack, BRAIN, "skin_body", "-p", patches)
            self._listens(stack, BRAIN, self.heard, "--body", *PATCHES.values())
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def waits_for(self, condition: Callable[[], object]) -> float:
        """Time until a condition holds, s; counts a hang if that is longer than patience_s."""
        begin_s = time.monotonic()
        while not condition():
            if time.monotonic() > begin_s + self.patience_s:
                self.hangs += 1
                break
            time.sleep(_TURN_S)
        return time.monotonic() - begin_s

    @property
    def newest(self) -> Heard | None:
        """The newest message of the body."""
        return next((h for h in reversed(self.heard) if h.kind == BODY_CONTACTS), None)

    def is_whole(self) -> bool:
        """Whether the body hears all patches now."""
        newest = self.newest
        return newest is not None and not newest.absent and self._is_new(newest)

    def is_witnessed(self) -> bool:
        """Whether what the body says now can be compared with what the patches' hosts heard."""
        long_ago_s = time.monotonic() - STALE_AFTER_S
        witnessed = {h.patch for h in self.truth if h.kind == CONTACTS and h.sent_s < long_ago_s}
        return witnessed.issuperset(PATCHES.values())

    def is_touched(self) -> bool:
        """Whether the body says so now."""
        newest = self.newest
        return newest is not None and newest.touched and self._is_new(newest)

    def is_untouched(self) -> bool:
        """Whether the body says so now."""
        newest = self.newest
        return newest is not None and newest.untouched and self._is_new(newest)

    def misses(self, sides: Iterable[str]) -> bool:
        """Whether the body says that these patches are absent."""
        newest = self.newest
        return newest is not None and {PATCHES[side] for side in sides}.issubset(newest.absent)

    def _is_new(self, message: Heard) -> bool:
        return message.sent_s > time.monotonic() - STALE_AFTER_S

    def feels(self, side: str) -> bool:
        """Whether a patch is touched, by the newest frame that its own host heard."""
        mine = (h for h in reversed(self.truth) if (h.kind, h.patch) == (CONTACTS, PATCHES[side]))
        return next((frame.touched for frame in mine), False)

    def said(self, side: str) -> str:
        """What the body says of a patch in its newest report; empty without one."""
        reports = (h.said for h in reversed(self.heard) if h.said)
        return next(reports, {}).get(PATCHES[side], "")

    def ended(self) -> int:
        """Number of programs that ended by themselves."""
        return sum(process.poll() is not None for process in self.processes)

    # ---- Programs

    def _starts(self, stack: ExitStack, host: str, script: str, *arguments: str) -> None:
        command = [sys.executable, str(ROOT / "scripts" / script), "--ros-args", *arguments]
        stack.enter_context(self._running(self.network.hosts[host], command, self._log))

    def _listens(self, stack: ExitStack, host: str, to: list[Heard], *arguments: str) -> None:
        command = [sys.executable, "-m", f"{__package__}.listener", *arguments]
        process = stack.enter_context(self._running(self.network.hosts[host], command, PIPE))

        def read() -> None:
            assert process.stdout is not None
            with process.stdout as lines:
                for line in lines:
                    to.append(Heard(**json.loads(line)))

        thread = threading.Thread(target=read)
        thread.start()
        stack.callback(thread.join)
        stack.callback(process.kill)

    @contextmanager
    def _running(
        self, host: Host, command: Sequence[str], output: object
    ) -> Iterator[subprocess.Popen[str]]:
        environment = {**self._environment, **self.clocks[host.name].environment}
        process = host.start(
            command, environment, stdin=DEVNULL, stdout=output, stderr=self._log, cwd=ROOT
        )
        self.processes.append(process)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def _values(side: str) -> list[str]:
    place = 0.2 if side == LEFT else -0.2
    values: dict[str, object] = {
        "port": f"sim://?{SCENES[side]}&heartbeat=5",
        "frame_period_ms": 1e3 * PERIOD_S,
        "contact_kpa": 5.0,
        "frame_id": side,
        "parent_frame": "body",
        "mount_xyz_m": [0.0, place, 0.0],
    }
    return [f for name, value in values.items() for f in ("-p", f"{name}:={json.dumps(value)}")]
