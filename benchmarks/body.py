# SPDX-License-Identifier: Apache-2.0

"""CPU time and latency of the node of a whole body: `make bench-body`.

Three processes: one publishes what eight drivers would, 50 frames per second each and out of step,
with four contacts of 20 taxels in each; the second is the body's node; this one subscribes to it.
A message's age begins with the stamp of its newest frame, which is when that was published, and
ends in the subscriber's callback. The share of a core is what Linux counts of the body's node.

And of one process with the drivers of 16 patches. In the place of their boards a process writes
into 16 ttys, in real time, what simulated ones sent to a recorder; every node speaks in every
frame. /body/contacts and /body/tactile are subscribed to meanwhile.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
import tty
from array import array
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.synchronize import Event as EventType
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from tactile_cdma import Decoder, read_recording
from tactile_cdma.places.layout import Layout

from .report import QUICK, ROOT, Report, be_alone
from .ros import cpu_s
from .style import sheet

PATCHES, RATE_HZ = 8, 50.0
MANY, SIZES = 16, (24, 48, 72, 96)
"""Patches of one process, and their numbers of taxels in turn."""
CONTACTS, TAXELS_OF_CONTACT = 4, 20
LOADS: dict[str, tuple[bool, int]] = {
    "contacts": (True, 16),
    "points of 8 × 16": (False, 16),
    "points of 8 × 4096": (False, 4096),
    "contacts, points of 8 × 16": (True, 16),
    "contacts, points of 8 × 4096": (True, 4096),
}
"""Whether contacts are subscribed to, and the number of taxels of a patch."""
SECONDS = 4.0 if QUICK else 20.0
WARM_UP_S = 1.0
SCRIPT = ROOT / "scripts" / "skin_body"
PATCH_NAMES = [f"/p{i}/skin" for i in range(PATCHES)]


@dataclass(slots=True)
class Result:
    """age_ms: of every message of contacts. points: messages. share: of a core.

    patches: there in the last message of taxels. sequences: of one patch's frames.
    """

    age_ms: list[float] = field(default_factory=list)
    points: int = 0
    share: float = 0.0
    patches: int = 0
    sequences: list[int] = field(default_factory=list)


def main() -> None:
    be_alone()
    report = Report("body", f"A body's node: {PATCHES} patches at {RATE_HZ:g} Hz")
    percent, rss_mb, frames_hz = one_process()
    found = {load: measure(load, *asked) for load, asked in LOADS.items()}
    rows = []
    for load, result in found.items():
        p50_ms, p99_ms = ages_ms(result)
        contacts_hz, points_hz = len(result.age_ms) / SECONDS, result.points / SECONDS
        rows.append([load, 100 * result.share, contacts_hz, p50_ms, p99_ms, points_hz])
    headers = ["asked for", "% of a core", "contacts Hz", "age p50 ms", "p99", "points Hz"]
    report.table(headers, rows)
    headers = ["drivers in one process", "% of a core", "RSS MB", "frames Hz"]
    report.table(headers, [[f"{MANY} of 24 to 96 taxels", percent, rss_mb, frames_hz]])
    alone, both = found["contacts"], found["contacts, points of 8 × 4096"]
    report.finish(
        picture(found),
        percent_16_patches=percent,
        rss_mb_16_patches=rss_mb,
        percent_contacts=100 * alone.share,
        percent_points_4096=100 * found["points of 8 × 4096"].share,
        percent_both_4096=100 * both.share,
        p50_ms_contacts=ages_ms(alone)[0],
        p50_ms_both_4096=ages_ms(both)[0],
        p99_ms_both_4096=ages_ms(both)[1],
        hz_contacts_both_4096=len(both.age_ms) / SECONDS,
    )


def measure(load: str, contacts: bool, taxels: int) -> Result:
    """Measure one load for SECONDS."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    drivers = context.Process(target=publish, args=(taxels, stop), daemon=True)
    drivers.start()
    names = "[" + ", ".join(PATCH_NAMES) + "]"
    body = subprocess.Popen([sys.executable, SCRIPT, "--ros-args", "-p", f"patches:={names}"])
    try:
        return listen(body.pid, contacts, points="points" in load)
    finally:
        body.terminate()
        body.wait(10)
        stop.set()
        drivers.join(10)


def one_process() -> tuple[float, float, float]:
    """Measure a process of MANY drivers: percent of a core, RSS, MB, frames of a patch per s."""
    with ExitStack() as ends:
        folder = Path(ends.enter_context(tempfile.TemporaryDirectory()))
        stop = multiprocessing.get_context("spawn").Event()
        boards = multiprocessing.get_context("spawn").Process(target=write, args=(folder, stop))
        boards.start()
        ends.callback(boards.join, 20)
        ends.callback(stop.set)
        while not (folder / f"tty{MANY - 1}").exists():
            time.sleep(0.1)
        processes = [
            started(ROOT / "scripts" / "skin_patches", str(many_patches(folder))),
            started(SCRIPT, "--ros-args", "-p", f"body_file:={folder / 'body.yaml'}"),
        ]
        for process in processes:
            ends.callback(process.wait, 20)
            ends.callback(process.terminate)
        drivers, result = processes[0], Result()
        with listening(partial(subscribe_to_many, result)) as spin:
            while result.patches < MANY:
                spin(0.1)
            spin(WARM_UP_S)
            result.sequences.clear()
            busy_s, begin_s = cpu_s(drivers.pid), time.monotonic()
            spin(SECONDS)
            passed_s = time.monotonic() - begin_s
        rss_kb = re.findall(r"VmRSS:\s+(\d+)", Path(f"/proc/{drivers.pid}/status").read_text())[0]
        share = (cpu_s(drivers.pid) - busy_s) / passed_s
        frames = result.sequences[-1] - result.sequences[0]
        return 100 * share, int(rss_kb) / 1024, frames / passed_s


def write(folder: Path, stop: EventType) -> None:
    """Write into ttys what boards send; runs in its own process."""
    from tactile_cdma.commands.cli import main as tactile_cdma

    sent = {}
    for nodes in SIZES:
        path, skin = folder / f"{nodes}.skin", ("--nodes", str(nodes), "--chip-us", "10")
        port = "sim://?scene=all&threshold=0&speed=0"
        period = ("--frame-period-ms", str(1e3 / RATE_HZ))
        tactile_cdma(["record", port, str(path), "--seconds", "2", *skin, *period])
        data = b"".join(data for data, _ in read_recording(path))
        decoder = Decoder(nodes=nodes, chip_us=10.0, frame_period_ms=1e3 / RATE_HZ)
        frames = decoder.feed(data, 0.0)
        size = len(data) // (frames[-1].sequence + 1)  # of a period
        sent[nodes] = [data[i : i + size] for i in range(0, len(data), size)]
    lines = []
    for i in range(MANY):
        master, line = os.openpty()
        tty.setraw(line)
        os.set_blocking(master, False)
        lines.append((master, sent[SIZES[i % len(SIZES)]]))
        (folder / f"tty{i}").symlink_to(os.ttyname(line))
    begin_s, count = time.monotonic(), 0
    while not stop.is_set():
        for master, pieces in lines:
            with suppress(BlockingIOError):  # nobody reads yet
                os.read(master, 4096)
            with suppress(BlockingIOError):
                os.write(master, pieces[count % len(pieces)])
        count += 1
        time.sleep(max(0.0, begin_s + count / RATE_HZ - time.monotonic()))


def many_patches(folder: Path) -> Path:
    """Return a body file of MANY patches of 24 to 96 taxels at RATE_HZ."""
    lines = ["process: one", "patches:"]
    for i in range(MANY):
        nodes, place = SIZES[i % len(SIZES)], f"[{0.1 * i}, 0.0, 0.0]"
        lines.append(
            f"  p{i}: {{parameters: {{port: {folder}/tty{i}, nodes: {nodes}, chip_us: 10.0, "
            f"frame_period_ms: {1e3 / RATE_HZ}, mount_xyz_m: {place}}}}}"
        )
    path = folder / "body.yaml"
    path.write_text("\n".join(lines))
    return path


def started(script: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Run a program of ours in a process of its own."""
    return subprocess.Popen([sys.executable, str(script), *arguments], stdout=subprocess.DEVNULL)


@contextmanager
def listening(subscribe: Callable[[Any], None]) -> Iterator[Callable[[float], None]]:
    """Give a node of this process to `subscribe`; yields a function that spins for some s."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    rclpy.init()
    node, executor = rclpy.create_node("listener"), SingleThreadedExecutor()
    subscribe(node)
    executor.add_node(node)

    def spin(seconds: float) -> None:
        deadline_s = time.monotonic() + seconds
        while time.monotonic() < deadline_s:
            executor.spin_once(0.1)

    yield spin
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


def subscribe_to_many(result: Result, node: Any) -> None:
    """Count what comes of a body's taxels, and take its contacts."""
    from rclpy.qos import qos_profile_sensor_data

    from tactile_cdma.msg import TactileArray, TactileBody, TactileContacts

    def take_array(message: Any) -> None:
        result.sequences.append(message.sequence)

    def take(message: Any) -> None:
        result.patches = len(message.patches) - len(message.absent)

    node.create_subscription(TactileBody, "/body/tactile", take, qos_profile_sensor_data)
    node.create_subscription(TactileArray, "/p0/skin/tactile", take_array, qos_profile_sensor_data)
    node.create_subscription(TactileContacts, "/body/contacts", lambda _: None, 10, raw=True)


def listen(body_pid: int, contacts: bool, points: bool) -> Result:
    """Subscribe to the body's topics once all its patches are there."""
    from sensor_msgs.msg import PointCloud2

    from tactile_cdma.msg import TactileContacts
    from tactile_cdma.ros.common.qos import PICTURE, RELIABLE

    result = Result()

    def take_contacts(message: Any) -> None:
        stamp = message.header.stamp
        result.age_ms.append(1e3 * (time.time() - stamp.sec) - 1e-6 * stamp.nanosec)

    def take_points(message: Any) -> None:
        result.points += 1

    def subscribe(node: Any) -> None:
        if contacts:
            node.create_subscription(TactileContacts, "/body/contacts", take_contacts, RELIABLE)
        if points:
            node.create_subscription(PointCloud2, "/body/points", take_points, PICTURE, raw=True)

    with listening(subscribe) as spin:
        while (contacts and not result.age_ms) or (points and not result.points):
            spin(0.1)
        spin(WARM_UP_S)
        result.age_ms.clear()
        result.points = 0
        busy_s, begin_s = cpu_s(body_pid), time.monotonic()
        spin(SECONDS)
        result.share = (cpu_s(body_pid) - busy_s) / (time.monotonic() - begin_s)
    return result


def publish(taxels: int, stop: EventType) -> None:
    """Publish in turn what the drivers of all patches would; runs in its own process."""
    import rclpy
    from tf2_msgs.msg import TFMessage

    from tactile_cdma.ros.common.transforms import STATIC

    rclpy.init()
    node = rclpy.create_node("drivers")
    layout = Layout.grid(taxels, 0, 0, 7e-3, 5.5e-3)
    static = node.create_publisher(TFMessage, "/tf_static", STATIC)
    static.publish(TFMessage(transforms=[mount(i) for i in range(PATCHES)]))
    frames = [driver(node, i, layout) for i in range(PATCHES)]
    begin_s, count = time.monotonic(), 0
    while not stop.is_set():
        frames[count % PATCHES](node.get_clock().now().to_msg())
        count += 1
        time.sleep(max(0.0, begin_s + count / (RATE_HZ * PATCHES) - time.monotonic()))
    rclpy.shutdown()


def mount(patch: int) -> Any:
    """Transform from the body to a patch."""
    from geometry_msgs.msg import TransformStamped
    from std_msgs.msg import Header

    transform = TransformStamped(header=Header(frame_id="body"), child_frame_id=f"p{patch}")
    transform.transform.translation.x = 0.1 * patch
    return transform


def driver(node: Any, patch: int, layout: Layout) -> Any:
    """Return a function that publishes a frame of a patch with a given stamp."""
    from geometry_msgs.msg import Point32, Vector3
    from rclpy.qos import qos_profile_sensor_data

    from tactile_cdma.msg import TactileArray, TactileContact, TactileContacts, TactileSkinInfo
    from tactile_cdma.ros.common.qos import LATCHED, RELIABLE

    name = PATCH_NAMES[patch]
    infos = node.create_publisher(TactileSkinInfo, f"{name}/info", LATCHED)
    arrays = node.create_publisher(TactileArray, f"{name}/tactile", qos_profile_sensor_data)
    contacts = node.create_publisher(TactileContacts, f"{name}/contacts", RELIABLE)
    places = [Point32(x=x, y=y, z=z) for x, y, z in layout.positions_m.tolist()]
    info = TactileSkinInfo(info_id=1, positions=places, normals=[Point32(z=1.0)] * len(places))
    info.height, info.width = 1, len(places)
    info.area, info.node = [1e-4] * info.width, list(range(1, info.width + 1))
    infos.publish(info)
    taxels = array("I", range(TAXELS_OF_CONTACT))
    touch = TactileContact(patch=name, force=Vector3(z=-1.0), normal=Vector3(z=1.0), taxels=taxels)
    touches = TactileContacts(touched=True, contacts=[touch] * CONTACTS)
    touches.taxels_valid = touches.taxels_in_service = len(layout)
    pressure_pa = array("f", np.linspace(0, 1e5, len(layout)).tolist())
    status = array("B", bytes(len(layout)))
    frame = TactileArray(info_id=1, pressure=pressure_pa, status=status)
    frame.height, frame.width = 1, len(layout)
    for message in (touches, frame):
        message.header.frame_id = f"p{patch}"

    def publish_one(stamp: Any) -> None:
        for publisher, message in ((contacts, touches), (arrays, frame)):
            message.header.stamp = stamp
            message.sequence += 1
            publisher.publish(message)

    return publish_one


def ages_ms(result: Result) -> list[float]:
    """Median and 99th percentile; NaN where no contacts were asked for."""
    ages = np.percentile(result.age_ms, [50, 99]) if result.age_ms else np.full(2, np.nan)
    return [round(age, 2) for age in ages.tolist()]


def picture(found: dict[str, Result]) -> Figure:
    figure = sheet(340)
    shares, ages = figure.subplots(1, 2, sharey=True)
    names = list(found)
    shares.barh(names, [100 * result.share for result in found.values()], color="C0")
    shares.set_xlabel("% of a core")
    shares.invert_yaxis()
    for percentile, marker in ((0, "o"), (1, "|")):
        label = ("median", "99 %")[percentile]
        values = [ages_ms(result)[percentile] for result in found.values()]
        ages.plot(values, names, marker, color="C1", label=label)
    ages.set(xscale="log", xlabel="age of contacts, ms")
    ages.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ages.xaxis.set_major_formatter("{x:g}")
    ages.xaxis.set_minor_formatter("")
    ages.legend()
    for axes in (shares, ages):
        axes.grid(alpha=0.3, axis="x", which="both")
    return figure


if __name__ == "__main__":
    main()
