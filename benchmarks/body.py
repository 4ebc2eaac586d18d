# SPDX-License-Identifier: Apache-2.0

"""CPU time and latency of the node of a whole body: `make bench-body`.

Three processes: one publishes what eight drivers would, 50 frames per second each and out of step,
with four contacts of 20 taxels in each; the second is the body's node; this one subscribes to it.
A message's age begins with the stamp of its newest frame, which is when that was published, and
ends in the subscriber's callback. The share of a core is what Linux counts of the body's node.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from array import array
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event as EventType
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tactile_cdma.places.layout import Layout

from .report import QUICK, Report, be_alone

PATCHES, RATE_HZ = 8, 50.0
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
SCRIPT = Path(__file__).resolve().parent.parent / "scripts" / "skin_body"
PATCH_NAMES = [f"/p{i}/skin" for i in range(PATCHES)]


@dataclass(slots=True)
class Result:
    """age_ms: of every message of contacts. points: messages. share: of a core."""

    age_ms: list[float] = field(default_factory=list)
    points: int = 0
    share: float = 0.0


def main() -> None:
    be_alone()
    report = Report("body", f"A body's node: {PATCHES} patches at {RATE_HZ:g} Hz")
    found = {load: measure(load, *asked) for load, asked in LOADS.items()}
    rows = []
    for load, result in found.items():
        p50_ms, p99_ms = ages_ms(result)
        contacts_hz, points_hz = len(result.age_ms) / SECONDS, result.points / SECONDS
        rows.append([load, 100 * result.share, contacts_hz, p50_ms, p99_ms, points_hz])
    headers = ["asked for", "% of a core", "contacts Hz", "age p50 ms", "p99", "points Hz"]
    report.table(headers, rows)
    alone, both = found["contacts"], found["contacts, points of 8 × 4096"]
    report.finish(
        picture(found),
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


def listen(body_pid: int, contacts: bool, points: bool) -> Result:
    """Subscribe to the body's topics once all its patches are there."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import PointCloud2

    from tactile_cdma.msg import TactileContacts
    from tactile_cdma.ros.common.qos import PICTURE, RELIABLE

    result = Result()

    def take_contacts(message: Any) -> None:
        stamp = message.header.stamp
        result.age_ms.append(1e3 * (time.time() - stamp.sec) - 1e-6 * stamp.nanosec)

    def take_points(message: Any) -> None:
        result.points += 1

    rclpy.init()
    node = rclpy.create_node("listener")
    if contacts:
        node.create_subscription(TactileContacts, "/body/contacts", take_contacts, RELIABLE)
    if points:
        node.create_subscription(PointCloud2, "/body/points", take_points, PICTURE, raw=True)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin_until(deadline_s: float) -> None:
        while time.monotonic() < deadline_s:
            executor.spin_once(0.1)

    while not (result.age_ms or not contacts) or not (result.points or not points):
        executor.spin_once(0.1)
    spin_until(time.monotonic() + WARM_UP_S)
    result.age_ms.clear()
    result.points = 0
    busy_s, begin_s = cpu_s(body_pid), time.monotonic()
    spin_until(begin_s + SECONDS)
    result.share = (cpu_s(body_pid) - busy_s) / (time.monotonic() - begin_s)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()
    return result


def cpu_s(pid: int) -> float:
    """CPU time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


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
    infos.publish(
        TactileSkinInfo(info_id=1, positions=places, normals=[Point32(z=1.0)] * len(places))
    )
    taxels = array("I", range(TAXELS_OF_CONTACT))
    touch = TactileContact(patch=name, force=Vector3(z=-1.0), normal=Vector3(z=1.0), taxels=taxels)
    touches = TactileContacts(touched=True, contacts=[touch] * CONTACTS)
    touches.taxels_valid = touches.taxels_in_service = len(layout)
    pressure_pa = array("f", np.linspace(0, 1e5, len(layout)).tolist())
    status = array("B", bytes(len(layout)))
    frame = TactileArray(info_id=1, pressure=pressure_pa, status=status)
    for message in (touches, frame):
        message.header.frame_id = f"p{patch}"

    def publish_one(stamp: Any) -> None:
        for publisher, message in ((contacts, touches), (arrays, frame)):
            message.header.stamp = stamp
            publisher.publish(message)

    return publish_one


def ages_ms(result: Result) -> list[float]:
    """Median and 99th percentile; NaN where no contacts were asked for."""
    ages = np.percentile(result.age_ms, [50, 99]) if result.age_ms else np.full(2, np.nan)
    return [round(age, 2) for age in ages.tolist()]


def picture(found: dict[str, Result]) -> Figure:
    figure = Figure(figsize=(8, 3))
    shares, ages = figure.subplots(1, 2, sharey=True)
    names = list(found)
    shares.barh(names, [100 * result.share for result in found.values()], color="C0")
    shares.set_xlabel("% of a core")
    shares.invert_yaxis()
    for percentile, marker in ((0, "o"), (1, "|")):
        label = ("median", "99 %")[percentile]
        values = [ages_ms(result)[percentile] for result in found.values()]
        ages.plot(values, names, marker, color="C1", label=label)
    ages.set_xscale("log")
    ages.set_xlabel("age of contacts, ms")
    ages.legend()
    for axes in (shares, ages):
        axes.grid(alpha=0.3, axis="x", which="both")
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
