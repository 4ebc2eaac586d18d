# SPDX-License-Identifier: Apache-2.0

"""The whole life of a driver, observed from inside: what it opened, wrote and started, as JSON.

Run as a program: watched_life.py PORT CALIBRATION. The hook sees what Python does; what C++ does,
DDS above all, is seen in /proc while everything is open.
"""

import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGING = ("os.chmod", "os.chown", "os.link", "os.mkdir", "os.remove", "os.rename", "os.rmdir")
CHANGING += ("os.symlink", "os.truncate", "os.utime", "shutil.")
STARTING = ("os.exec", "os.fork", "os.posix_spawn", "os.spawn", "os.system", "pty.spawn")
STARTING += ("subprocess.Popen",)

written: list[str] = []
changed: list[str] = []
others: list[str] = []  # programs started, sockets, pickles


def watch(event: str, arguments: tuple[Any, ...]) -> None:
    """Audit hook."""
    if event == "open":
        path, _, flags = arguments
        if flags & WRITING and not isinstance(path, int):
            written.append(os.fsdecode(path))
    elif event.startswith(CHANGING):
        changed.extend(os.fsdecode(a) for a in arguments if isinstance(a, str | bytes | Path))
    elif event.startswith((*STARTING, "socket.", "pickle.", "urllib.")):
        others.append(f"{event} {arguments}")


def sockets() -> dict[str, list[str]]:
    """Local addresses of this process's sockets, by protocol."""
    own = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # that of the listing itself
            own.add(os.readlink(descriptor))
    found: dict[str, list[str]] = {}
    for protocol in ("tcp", "tcp6", "udp", "udp6", "raw", "raw6", "packet", "unix"):
        lines = Path("/proc/self/net", protocol).read_text().splitlines()[1:]
        place = {"unix": 6, "packet": 8}.get(protocol, 9)  # of the inode in a line
        mine = [line.split() for line in lines if f"socket:[{line.split()[place]}]" in own]
        found[protocol] = [fields[1] for fields in mine]
    return found


def open_files() -> list[str]:
    """Everything open that has a path, and all that is mapped to be written to and shared."""
    found = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            flags = int(Path("/proc/self/fdinfo", descriptor.name).read_text().split()[3], 8)
            path = os.readlink(descriptor)
            if flags & WRITING and path.startswith("/") and int(descriptor.name) > 2:
                found.add(path)
    for line in Path("/proc/self/maps").read_text().splitlines():
        fields = line.split(maxsplit=5)
        if fields[1].startswith("rw-s"):
            found.add(fields[5])
    return sorted(found)


def main() -> None:
    sys.addaudithook(watch)
    # Not before: what they import and open is to be seen, too.
    import rclpy
    from sensor_msgs.msg import Image, PointCloud2
    from std_srvs.srv import Trigger
    from visualization_msgs.msg import MarkerArray

    from tactile_cdma.srv import Tare
    from test.support.skin_client import running
    from test.support.waiting import wait_for

    port, calibration = sys.argv[1:]
    rclpy.init()
    with running(port=port, parent_frame="palm") as (_, client):
        seen: dict[str, int] = {}
        for kind, topic in (
            (Image, "heatmap"),
            (PointCloud2, "points"),
            (MarkerArray, "markers"),
        ):
            count = lambda _, topic=topic: seen.update({topic: 1})  # noqa: E731
            client.create_subscription(kind, f"/skin/{topic}", count, 1)
        wait_for(lambda: len(client.arrays) > 100 and len(seen) == 3)
        assert client.call(Tare, "tare", Tare.Request(force=True)).success
        assert client.set(calibration_file=calibration) == (True, "")
        assert client.call(Trigger, "save_calibration", Trigger.Request()).success
        found = {"open": open_files(), "sockets": sockets()}
        assert client.change("deactivate", "cleanup")
    rclpy.shutdown()
    found |= {"written": written, "changed": changed, "others": others}
    print(json.dumps({**found, "user": [os.getresuid(), os.getgroups()]}))


if __name__ == "__main__":
    main()
