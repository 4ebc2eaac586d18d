# SPDX-License-Identifier: Apache-2.0

"""CPU time of the driver for pictures of the skin: `make bench-pictures`.

Each of the driver's pictures, of 16 to 4096 taxels in a square that several things press, at most
16: drawn (a finished message), and drawn and published to a subscriber in another process, which
does not look into it. Times are CPU time of the thread that does it, nearly all with Python's lock,
for which the decoder waits. Markers are measured with the squares of the surface, whatever the
size, and with the contacts alone, which is all that skins of more than MOST_SQUARES have.
Following the contacts is `make bench-contact`'s.
"""

from __future__ import annotations

import multiprocessing
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle
from multiprocessing.synchronize import Event as EventType
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.config.parameters import PARAMETERS, Values
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.contact import Contacts, ContactTracker
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES
from tactile_cdma.views.cloud import POINT, Cloud
from tactile_cdma.views.heatmap import heatmap, pressure_raster

from .report import QUICK, Report, be_alone, medians_s
from .style import sheet

SIZES = (16, 256, 1024, 4096)
ROUNDS = 7 if QUICK else 31
FRAMES = 32
DEFAULTS: Values = {parameter.name: parameter.default for parameter in PARAMETERS}
RATE_HZ = DEFAULTS["visual_rate_hz"]
MAX_PA = 1e3 * DEFAULTS["colour_max_kpa"]
PIXELS = DEFAULTS["heatmap_pixels"]
HEATMAP, IMAGE, POINTS = "heatmap", "pressure_image", "points"
CONTACTS, SQUARES = "markers, contacts alone", "markers with squares"

Frame = tuple[NDArray[np.float32], Contacts]
Times = dict[tuple[int, str], tuple[float, float]]
"""Time to draw, and to draw and publish, s, by number of taxels and picture."""


def main() -> None:
    be_alone()
    report = Report("pictures", "Drawing and publishing pictures of the skin")
    found = times(report)
    report.finish(
        picture(found),
        us_heatmap_16=1e6 * found[16, HEATMAP][1],
        us_heatmap_4096=1e6 * found[4096, HEATMAP][1],
        us_points_16=1e6 * found[16, POINTS][1],
        us_points_4096=1e6 * found[4096, POINTS][1],
        us_draw_points_4096=1e6 * found[4096, POINTS][0],
        us_markers_16=1e6 * found[16, SQUARES][1],
        us_markers_256=1e6 * found[256, SQUARES][1],
        us_squares_1024=1e6 * found[1024, SQUARES][1],
        us_contacts_4096=1e6 * found[4096, CONTACTS][1],
    )


def times(report: Report) -> Times:
    result: Times = {}
    rows = []
    with publishers() as publish:
        for taxels in SIZES:
            for name, draw in drawings(taxels).items():
                both = medians_s(
                    {"draw": draw, "publish": lambda d=draw, n=name: publish(n, d())},  # type: ignore[misc]
                    ROUNDS,
                    least_s=20e-3,
                    clock=time.thread_time,
                )
                result[taxels, name] = drawn_s, published_s = both["draw"], both["publish"]
                size_kb = len(draw()) / 1e3
                us = 1e6 * drawn_s, 1e6 * published_s
                rows.append([taxels, name, *us, 100 * RATE_HZ * published_s, size_kb])
    report.table(
        ["taxels", "picture", "µs drawn", "and published", f"% of a core at {RATE_HZ:g} Hz", "kB"],
        rows,
    )
    return result


def drawings(taxels: int) -> dict[str, Callable[[], Any]]:
    """Functions by picture, each of which draws one frame after the other."""
    from tactile_cdma.messages.cdr import Heading
    from tactile_cdma.ros.common import convert
    from tactile_cdma.ros.driver.markers import SkinMarkers

    layout, heading = Layout.grid(taxels, 0, 0, 7e-3, 5.5e-3), Heading(0, "skin")
    cloud, frames = Cloud(layout.positions_m, layout.normals), cycle(pressed(layout))

    def markers(most_squares: int) -> Callable[[], Any]:
        builder = SkinMarkers(layout, most_squares)

        def draw() -> Any:
            pressure_pa, contacts = next(frames)
            return builder.markers(pressure_pa, MAX_PA, contacts, heading, lifetime_s=1.0)

        return draw

    return {
        HEATMAP: lambda: convert.image(
            heatmap(next(frames)[0], layout, MAX_PA, PIXELS), "rgb8", heading
        ),
        IMAGE: lambda: convert.image(pressure_raster(next(frames)[0], layout), "32FC1", heading),
        POINTS: lambda: convert.point_cloud(
            POINT, [cloud.points(next(frames)[0], MAX_PA)], heading
        ),
        CONTACTS: markers(most_squares=0),
        SQUARES: markers(most_squares=taxels),
    }


def pressed(layout: Layout) -> list[Frame]:
    """Return frames of readings and their contacts, with touches that come and go."""
    skin = SimOptions().skin(len(layout))
    tracker = ContactTracker(layout, SkinConfig.of({}).contact)
    status, frames = np.zeros(len(layout), dtype=np.uint8), []
    for t_s in np.arange(FRAMES) / RATE_HZ:
        pressure_pa = SCENES["presses"](t_s, skin).astype(np.float32)
        contacts = tracker.update(Readings(pressure_pa, pressure_pa, status), t_s)
        frames.append((pressure_pa, contacts))
    return frames


@contextmanager
def publishers() -> Iterator[Callable[[str, Any], None]]:
    """Yield a function that publishes a picture by name to a subscriber in another process."""
    import rclpy

    from tactile_cdma.ros.common.qos import PICTURE
    from tactile_cdma.ros.driver.pictures import TOPICS

    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    subscriber = context.Process(target=subscribe, args=(stop,), daemon=True)
    subscriber.start()
    rclpy.init()
    node = rclpy.create_node("skin")
    by_topic = {t: node.create_publisher(kind, f"~/{t}", PICTURE) for t, kind in TOPICS.items()}
    for publisher in by_topic.values():
        while not publisher.get_subscription_count():
            rclpy.spin_once(node, timeout_sec=0.1)
    yield lambda name, message: by_topic[re.split(r"\W", name)[0]].publish(message)
    stop.set()
    subscriber.join(10)
    rclpy.shutdown()


def subscribe(stop: EventType) -> None:
    """Take every picture."""
    import rclpy

    from tactile_cdma.ros.common.qos import PICTURE
    from tactile_cdma.ros.driver.pictures import TOPICS

    rclpy.init()
    node = rclpy.create_node("subscriber")
    for topic, kind in TOPICS.items():
        node.create_subscription(kind, f"/skin/{topic}", lambda _: None, PICTURE, raw=True)
    while not stop.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)


def picture(found: Times) -> Figure:
    figure = sheet(520)
    axes = figure.subplots()
    for colour, name in enumerate((HEATMAP, IMAGE, POINTS, CONTACTS, SQUARES)):
        drawn, published = 1e6 * np.array([found[taxels, name] for taxels in SIZES]).T
        axes.loglog(SIZES, published, "o-", color=f"C{colour}", label=name)
        axes.loglog(SIZES, drawn, "x:", color=f"C{colour}")
    axes.plot([], [], "x:", color="0.5", label="only drawn")
    axes.set_xticks(SIZES, [str(taxels) for taxels in SIZES])
    axes.set_xticks([], minor=True)
    axes.set(xlabel="taxels", ylabel="µs per picture")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
