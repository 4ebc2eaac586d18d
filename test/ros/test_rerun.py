# SPDX-License-Identifier: Apache-2.0

"""The bridge to the Rerun viewer, against a real driver: what it saves is what was published."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun-sdk is not installed (make view)")

import rerun as rr

from tactile_cdma.places.layout_file import Wiring, read_layout
from tactile_cdma.ros.viewers.rerun_view import RerunView
from tactile_cdma.views.heatmap import NO_READING_RGB, colours
from tactile_cdma.views.live import OLD_S
from test.support.rerun_files import columns_of
from test.support.skin_client import running
from test.support.spinning import spinning
from test.support.waiting import wait_for

LAYOUT = Path(__file__).resolve().parents[2] / "config" / "layouts" / "cylinder.yaml"


def test_what_is_saved_is_what_was_published(tmp_path: Path) -> None:
    file = tmp_path / "touch.rrd"
    port = f"sim://?scene=presses&layout={LAYOUT}"
    skin = {"port": port, "nodes": 72, "frame_period_ms": 50.0, "layout_file": str(LAYOUT)}
    skin |= {"parent_frame": "arm", "mount_xyz_m": [0.0, 0.5, 0.0]}
    with running(**skin) as (_, client), saving(file):
        wait_for(lambda: len(client.arrays) > 60)
        client.diagnostics.clear()
        wait_for(lambda: client.diagnostics)

    saved = columns_of(file)
    layout = read_layout(LAYOUT, Wiring(nodes=72))
    [corners_m] = saved["/skin/surface", "Mesh3D:vertex_positions"]
    np.testing.assert_allclose(np.reshape(corners_m, (-1, 6, 3)), layout.squares_m, atol=1e-7)
    [place_m] = saved["/skin", "Transform3D:translation"]
    np.testing.assert_allclose(place_m, [[0.0, 0.5, 0.0]])
    # Every peak of the curve was published, and they are in step with the frames' stamps.
    published = {stamp_ns(array): np.array(array.pressure) for array in client.arrays}
    peaks = dict(
        zip(saved["/skin/peak", "stamp"], saved["/skin/peak", "Scalars:scalars"], strict=True)
    )
    both = published.keys() & peaks.keys()
    assert len(both) > 20
    for stamp in both:
        assert peaks[stamp] == [pytest.approx(np.nanmax(published[stamp]) / 1e3, rel=1e-6)]
    # So do the colours of the surface: six corners of a taxel have the heatmap's colour.
    surfaces = zip(
        saved["/skin/surface", "stamp"], saved["/skin/surface", "Mesh3D:vertex_colors"], strict=True
    )
    compared = 0
    for stamp, packed in surfaces:
        if stamp in published:
            rgb = np.array(packed, dtype=">u4").view(np.uint8).reshape(-1, 6, 4)[..., :3]
            paint = colours(published[stamp].astype(np.float32), 140e3)
            np.testing.assert_array_equal(rgb, paint[:, None].repeat(6, axis=1))
            compared += 1
    assert compared > 10
    assert any(text.startswith("skin: ") for [text] in saved["/skin/diagnostics", "TextLog:text"])
    assert max(len(forces) for forces in saved["/skin/contacts", "Arrows3D:vectors"]) >= 1


def test_a_skin_that_is_pressed_dies_and_stops_is_drawn_as_such(tmp_path: Path) -> None:
    """At first all is read, then the nodes are dead, then there are no frames."""
    file, dead = tmp_path / "dead.rrd", ",".join(str(node) for node in range(1, 17))
    port = f"sim://?scene=all&threshold=0&dead={dead}&dead_after="
    for dead_after_s, stops in ((3.0, False), (60.0, True)):
        with running(port=f"{port}{dead_after_s}", stale_after_s=0.5) as (_, client), saving(file):
            wait_for(lambda client=client: len(client.arrays) > 100)
            if stops:
                assert client.change("deactivate")
                time.sleep(OLD_S + 1.0)
            else:
                wait_for(lambda client=client: np.isnan(client.arrays[-1].pressure).all())
                time.sleep(1.0)
        saved = columns_of(file)
        forces_n = np.ravel(saved["/skin/force", "Scalars:scalars"])
        peaks_kpa = np.ravel(saved["/skin/peak", "Scalars:scalars"])
        for curve in (forces_n, peaks_kpa):
            assert np.nanmax(curve) > 1.0
            assert np.isnan(curve[-1])
            assert not (curve == 0).any()
        assert np.isnan(np.ravel(saved["/skin/force/contact_1", "Scalars:scalars"])[-1])
        [*_, last] = saved["/skin/surface", "Mesh3D:vertex_colors"]
        rgb = np.array(last, dtype=">u4").view(np.uint8).reshape(-1, 4)[:, :3]
        assert (rgb == NO_READING_RGB).all()
        assert saved["/skin/contacts", "Arrows3D:vectors"][-1] == []


@contextmanager
def saving(file: Path) -> Iterator[None]:
    """The bridge, which saves all patches in a file."""
    recording = rr.RecordingStream("test")
    recording.save(file)
    view = RerunView(recording, [], 140e3)
    try:
        with spinning([view]):
            yield
            view.show()
        view.flush()
    finally:
        recording.flush()
        recording.disconnect()


def stamp_ns(message: object) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
