# SPDX-License-Identifier: Apache-2.0

"""Hosts on one machine: namespaces of network, mounts and /dev/shm, joined by the relay."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from subprocess import PIPE

from .relay import Counts, Weather

TOOLS = {"unshare": "util-linux", "nsenter": "util-linux", "ip": "iproute2", "cc": "gcc"}
"""Programs that hosts and their clocks take, and Debian's packages with them."""
TUN = Path("/dev/net/tun")
NETWORK = "10.91.0"
"""Addresses of the hosts; nothing of them is seen outside of their namespaces."""
OWN_SHM = "mount -t tmpfs tmpfs /dev/shm"
"""Without it, Fast DDS finds that all hosts are this one, and uses its shared memory."""
HOST = f"{OWN_SHM} && ip link set lo up && echo ready && exec cat"
"""The program that keeps a host's namespaces: ends with its input."""


def why_not() -> str:
    """Why there cannot be hosts on this machine; empty if there can."""
    if os.geteuid():
        return "network namespaces need root"
    for tool, package in TOOLS.items():
        if not shutil.which(tool):
            return f"no {tool}: apt install {package}"
    if not TUN.exists():
        return f"no {TUN}: the kernel has no TAP interfaces, or this container none"
    try:
        with Network(("a", "b")) as network:
            network.set(Weather())
    except (OSError, subprocess.SubprocessError) as error:
        return f"namespaces are not allowed here: {error}"
    return ""


class Host:
    """The namespaces of one host; a context manager.

    name: of its interface. address: its IPv4 address.
    """

    def __init__(self, name: str, address: str) -> None:
        self.name, self.address = name, address
        self._keeper = _started(["unshare", "--net", "--mount", "sh", "-c", HOST])

    @property
    def pid(self) -> int:
        """The process whose namespaces they are."""
        return self._keeper.pid

    def command(self, *command: str) -> list[str]:
        """The command that runs this one on the host."""
        return ["nsenter", "--target", str(self.pid), "--net", "--mount", *command]

    def start(
        self, command: Sequence[str], environment: Mapping[str, str], **options: object
    ) -> subprocess.Popen[str]:
        """Start a program on the host."""
        process: subprocess.Popen[str] = subprocess.Popen(
            self.command(*command),
            env=dict(environment),
            text=True,
            **options,  # type: ignore[call-overload]
        )
        return process

    def __enter__(self) -> Host:
        return self

    def __exit__(self, *_: object) -> None:
        _end(self._keeper)


class Network:
    """Hosts of these names, and the network between them; a context manager."""

    def __init__(self, names: Sequence[str], seed: int = 0) -> None:
        self._names, self._seed = names, seed
        self.hosts: dict[str, Host] = {}
        self._weather, self._before = Weather(), Counts()
        self._stack = ExitStack()

    def __enter__(self) -> Network:
        with ExitStack() as stack:
            relay = [sys.executable, "-m", f"{__package__}.relay", str(self._seed), *self._names]
            self._relay = _started(["unshare", "--net", *relay])
            stack.callback(_end, self._relay)
            for number, name in enumerate(self._names, 1):
                host = Host(name, f"{NETWORK}.{number}")
                self.hosts[name] = stack.enter_context(host)
                self._plug(host)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def set(self, weather: Weather) -> None:
        """Change the weather."""
        self._weather = weather
        self._counted()

    def count_anew(self) -> None:
        """Begin to count again from 0."""
        self._before = self._counted()

    @property
    def counts(self) -> Counts:
        """What happened to the frames since then."""
        now, before = asdict(self._counted()), asdict(self._before)
        return Counts(**{name: count - before[name] for name, count in now.items()})

    def _counted(self) -> Counts:
        """Tell the relay the weather; it answers with what it has counted."""
        assert self._relay.stdin is not None and self._relay.stdout is not None
        print(json.dumps(asdict(self._weather)), file=self._relay.stdin, flush=True)
        return Counts(**json.loads(self._relay.stdout.readline()))

    def _plug(self, host: Host) -> None:
        """Give a host the relay's interface of its name."""
        in_relay = ["nsenter", "--target", str(self._relay.pid), "--net"]
        move = f"ip link set dev {host.name} netns {host.pid}"
        _done([*in_relay, *move.split()])
        for command in (
            f"ip address add {host.address}/24 dev {host.name}",
            f"ip link set dev {host.name} up",
            f"ip route add default dev {host.name}",  # of multicast, too
        ):
            _done(host.command(*command.split()))


def _started(command: Sequence[str]) -> subprocess.Popen[str]:
    """Start a program that says "ready", and ends with its input."""
    process = subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=PIPE, text=True)
    assert process.stdout is not None and process.stderr is not None
    if process.stdout.readline() != "ready\n":
        complaint = process.stderr.read().strip()
        _end(process)
        raise OSError(complaint or f"{command[0]} ended")
    return process


def _end(process: subprocess.Popen[str]) -> None:
    process.communicate()  # closes its input


def _done(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip()}")
