#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Draws pictures of the pages: .venv/bin/python tools/page_pictures.py [NAME …].

Those that explain are computed by the project's own code, without hardware, within seconds. Those
of benchmarks are drawn anew from the last full run, as docs/results.json has it.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks import style  # noqa: E402
from benchmarks.doubt.lines import FEW  # noqa: E402
from benchmarks.doubt.words import play  # noqa: E402
from tactile_cdma import Body, Frame, Status  # noqa: E402
from tactile_cdma import Skin as LiveSkin  # noqa: E402
from tactile_cdma.base.arrays import Floats  # noqa: E402
from tactile_cdma.calibrating.load_points import LoadPoints  # noqa: E402
from tactile_cdma.calibrating.skin_fit import fit_skin  # noqa: E402
from tactile_cdma.code.encode import line_chips, word_bits  # noqa: E402
from tactile_cdma.code.frame import FrameSpec  # noqa: E402
from tactile_cdma.code.transform import rows_of  # noqa: E402
from tactile_cdma.config.frame_rate import frames_of  # noqa: E402
from tactile_cdma.config.parameters import DEFAULTS, DRIVES, KINDS  # noqa: E402
from tactile_cdma.config.skin_config import SkinConfig  # noqa: E402
from tactile_cdma.framing.frames import Clause  # noqa: E402
from tactile_cdma.places.layout import Layout  # noqa: E402
from tactile_cdma.places.layout_file import read_layout  # noqa: E402
from tactile_cdma.places.layout_nodes import Wiring  # noqa: E402
from tactile_cdma.readings.contact import Contacts, ContactTracker  # noqa: E402
from tactile_cdma.readings.taxels import Readings  # noqa: E402
from tactile_cdma.sim.indenters import Foundation, Sphere  # noqa: E402
from tactile_cdma.sim.options import SimOptions  # noqa: E402
from tactile_cdma.sim.scene import DWELL_S, LOADS, STEPS_KPA  # noqa: E402
from tactile_cdma.views.heatmap import colours, heatmap  # noqa: E402
from test.support.independent_line import Digitizer, Line, Skin, render  # noqa: E402

IMAGES = ROOT / "docs" / "img"
RESULTS = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
MAX_PA, PIXELS = 1e3 * DEFAULTS["colour_max_kpa"], 56
DEAD = 14
"""Number of the node that does not speak in a picture."""
SETTLED_S = 1.2
"""Part of a load's duration that is left out, s: the sensor lags."""


def draw_curve() -> Figure:
    """The two-stage curve: points of a calibration, what is fitted, and what that is off by."""
    nodes, url = 16, "sim://?scene=steps&sensor=paper&mismatch=0.05&threshold=0&seed=3&speed=0"
    points, config = plateaus(url, nodes), SkinConfig.of({"nodes": nodes})
    fit = fit_skin(points, nodes, config.adc)
    figure = style.sheet(430)
    left, right = figure.subplots(1, 2)
    kpa, volts = points.pressure_pa / 1e3, points.voltage_v
    for node, colour, marker in zip((2, 6, 11), style.CYCLE, style.MARKERS, strict=False):
        own, fitted = points.node == node, fit.curves[node]
        left.plot(kpa[own], volts[own], marker, color=colour, ms=5, alpha=0.6)
        fitted_kpa = np.array(fitted.pressure_pa) / 1e3
        left.plot(fitted_kpa, fitted.voltage_v, color=colour, lw=1.5, label=f"node {node}")
    plain_kpa = np.array(config.curve.pressure_pa) / 1e3
    left.plot(plain_kpa, config.curve.voltage_v, "--", color=style.BLACK, lw=1.5, label="no file")
    left.set(xlabel="load, kPa", ylabel="voltage, V", title="Points, and curves of two stages")
    left.legend()
    first = np.arange(len(points)) // nodes <= STEPS_KPA.index(max(STEPS_KPA))
    for some, colour, name in ((first, style.BLUE, "loading"), (~first, style.ORANGE, "unloading")):
        off_kpa = fit.residual_pa[some] / 1e3
        right.plot(kpa[some], off_kpa, ".", color=colour, label=name, ms=6)
    for (begin, end), lsb_kpa in zip(((0, 50), (50, 140)), (0.098, 0.546), strict=True):
        right.fill_between((begin, end), -lsb_kpa / 2, lsb_kpa / 2, color=style.BLACK, lw=0)
    right.set(xlabel="load, kPa", ylabel="error, kPa", title="Errors of 16 nodes; black: ±½ count")
    right.legend(loc="upper left")
    return figure


def plateaus(url: str, nodes: int) -> LoadPoints:
    """Return what a skin of the scene "steps" measures under each load, once it has settled."""
    found: dict[int, list[NDArray[np.float32]]] = {}
    with LiveSkin(url, nodes=nodes) as skin:
        begin_s = skin.read().t_device
        for frame in skin:
            step, within_s = divmod(frame.t_device - begin_s, DWELL_S)
            if step >= len(STEPS_KPA):
                break
            if within_s > SETTLED_S:
                found.setdefault(int(step), []).append(frame.voltage_v)
    one = SimOptions().skin(nodes=1)
    loads_pa = [LOADS["steps"]((step + 0.9) * DWELL_S, one)[0] for step in found]
    volts = np.array([np.mean(some, axis=0) for some in found.values()], dtype=np.float64)
    node, line = np.tile(np.arange(1, nodes + 1), len(loads_pa)), np.arange(volts.size)
    return LoadPoints(node, np.repeat(loads_pa, nodes), volts.ravel(), line, "a simulated skin")


def draw_frame() -> Figure:
    """A frame on the wire: the chips of some nodes, their sum, and the words out of it."""
    codes, speaks = np.array([0b1011, 0b0110, 0b0001, 0b1100]) << 4, [True, True, False, True]
    spec = FrameSpec(nodes=4, bits=8, order=8, chip_s=50e-6, frame_period_s=5e-3)
    shown_bits, order = 4, spec.order
    figure = style.sheet(640)
    grid = figure.subplot_mosaic([["chips", "chips"], ["line", "line"], ["rows", "words"]],
                                 height_ratios=(1.25, 1, 1))  # fmt: skip
    chips, line, rows, words = (grid[name] for name in ("chips", "line", "rows", "words"))
    at = np.arange(shown_bits * order + 1)
    for i in range(spec.nodes):
        own = np.arange(spec.nodes) == i
        sent = line_chips(spec, codes, own & np.array(speaks), 1.0)[:shown_bits].ravel()
        chips.step(at, 0.38 * np.append(sent, sent[-1]) - i, where="post", color=style.CYCLE[i])
    chips.set(
        xlim=(0, at[-1]), yticks=-np.arange(4), yticklabels=[f"node {i + 1}" for i in range(4)]
    )
    chips.set_title("Each node multiplies its bits (1: +, 0: −) with its own row; node 3 is silent")
    rng = np.random.default_rng(1)
    total = line_chips(spec, codes, speaks, 0.3) + rng.normal(0, 0.02, (spec.bits, order))
    samples = total[:shown_bits].ravel().repeat(4) + rng.normal(0, 0.03, 4 * at[-1])
    line.plot((np.arange(samples.size) + 0.5) / 4, samples, ".", color=style.BLACK, ms=4)
    line.set(xlim=(0, at[-1]), ylabel="V", title="The wire carries their sum: 4 samples a chip")
    for axes in (chips, line):
        axes.set_xticks(np.arange(shown_bits + 1) * order, [""] * (shown_bits + 1))
        axes.grid(axis="y", visible=False)
    middles = (np.arange(shown_bits) + 0.5) * order
    line.set_xticks(middles, [f"bit {7 - b}" for b in range(shown_bits)], minor=True)
    levels = rows_of(np.asarray(total, dtype=np.float32), spec)
    levels = levels[:, spec.rows] * spec.signs if levels.shape[1] != spec.nodes else levels
    width = 0.2
    for i in range(spec.nodes):
        place = np.arange(shown_bits) + (i - 1.5) * width
        rows.bar(place, levels[:shown_bits, i], width, color=style.CYCLE[i])
    rows.axhline(0, color=style.BLACK, lw=1)
    rows.set_xticks(range(shown_bits), [f"bit {7 - b}" for b in range(shown_bits)])
    rows.set(ylabel="V", title="Correlation with each row")
    words.axis("off")
    words.set_title("Signs are the words")
    for i in range(spec.nodes):
        bits = "".join(map(str, word_bits(codes, spec.bits)[i][:shown_bits])) + " …"
        text = f"node {i + 1}:  {bits if speaks[i] else 'silent'}"
        words.text(0.05, 0.8 - 0.22 * i, text, color=style.CYCLE[i], family="monospace", size=16)
    return figure


def pressed(dead: bool) -> tuple[Layout, NDArray[np.float32], NDArray[np.uint8], Contacts]:
    """Return a skin of 8 × 8 taxels, pressed in two places; dead: a node does not speak."""
    url = "sim://?scene=presses&seed=4&threshold=0&speed=0" + dead * f"&dead={DEAD}"
    with LiveSkin(url, nodes=64, frame_period_ms=40.0, contacts=True) as skin:
        frames = [*islice(skin, 100, 400)]

    def reach(frame: Frame) -> tuple[bool, float]:
        dark = bool(np.isnan(frame.pressure_pa[DEAD - 1 : DEAD]).any())
        found = frame.contacts
        least = min(found.load_n[:3]) if found is not None and len(found) > 2 else 0.0
        return dark == dead, least

    frame = max(frames, key=reach)
    assert frame.contacts is not None
    return skin.layout, frame.pressure_pa, frame.status, frame.contacts


def draw_messages() -> Figure:
    """A heatmap, and what the messages say of it."""
    layout, pressure_pa, status, contacts = pressed(dead=True)
    figure = style.sheet(500)
    axes, notes = figure.subplots(1, 2, width_ratios=(1, 1.1))
    axes.imshow(heatmap(pressure_pa, layout, MAX_PA, PIXELS), extent=(-0.5, 7.5, 7.5, -0.5))
    axes.set(xticks=range(8), yticks=range(8), title="~/heatmap")
    axes.grid(visible=False)
    axes.tick_params(length=0)
    notes.axis("off")
    notes.set(xlim=(0, 1), ylim=(0, 1))
    cells = {int(np.nanargmax(pressure_pa)): "", int(np.flatnonzero(np.isnan(pressure_pa))[0]): ""}
    lines: list[tuple[tuple[float, float], str]] = []
    for taxel in cells:
        names = " | ".join(one.name for one in Status if one & int(status[taxel]) == one) or "0"
        value = "NaN" if np.isnan(pressure_pa[taxel]) else f"{pressure_pa[taxel]:.0f} Pa"
        text = f"~/tactile\n  pressure[{taxel}]: {value}\n  status[{taxel}]: {names}"
        lines.append((divmod(taxel, 8)[::-1], text))
    pitch_m = layout.pitch_m
    for one in contacts.contacts[:2]:
        x, y = one.position[:2] / pitch_m
        text = (
            f"~/contacts, id {one.id}\n  force.z: {one.force[2]:.1f} N, "
            f"area: {one.area * 1e4:.1f} cm²\n"
            f"  pressure_max: {one.pressure_max / 1e3:.0f} kPa, {len(one.taxels)} taxels"
        )
        lines.append(((3.5 + x, 3.5 - y), text))
    force, torque = contacts.wrench[:3], contacts.wrench[3:]
    for i, (place, text) in enumerate(sorted(lines, key=lambda line: line[0][1])):
        height = 0.93 - 0.215 * i
        axes.annotate("", place, (8.0, 0.3 + 1.85 * i), annotation_clip=False,
                      arrowprops={"arrowstyle": "->", "color": style.SKY, "lw": 1.8})  # fmt: skip
        notes.text(0.02, height, text, va="top", family="monospace", size=12)
    text = f"~/wrench  force.z: {force[2]:.1f} N, torque: {torque[0]:.2f}, {torque[1]:.2f} N m"
    notes.text(0.02, 0.05, text, family="monospace", size=12)
    return figure


ARC_M, TURN = 63e-3, 0.6
"""Length of a finger, m, and by how much it is bent, rad."""


def hand_layout() -> Layout:
    """Return a palm with four fingers and a thumb, bent as around a bottle."""
    rows = list[str]()

    def patch(origin: tuple[float, float], turn: float, size: tuple[int, int], bend: float) -> None:
        across, along = size
        cos, sin = np.cos(turn), np.sin(turn)
        spin = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        for j, i in np.ndindex(along, across):
            x, y = 9.0 * (i - (across - 1) / 2), 9.0 * (j + 0.5)
            tilt = bend * y / (1e3 * ARC_M)
            arc = y / tilt if tilt else 1.0
            place = [x, arc * np.sin(tilt) if tilt else y, arc * (1 - np.cos(tilt))]
            place = (spin @ place + [*origin, 0]).round(3).tolist()
            normal = (spin @ [0.0, -np.sin(tilt), np.cos(tilt)]).round(4).tolist()
            rows.append(
                f"  - {{position_mm: {place}, normal: {normal}, area_mm2: 64, "
                f"node: {len(rows) + 1}}}"
            )

    patch((0, -40), 0.0, (8, 8), 0.0)
    for x, along in ((-30, 6), (-10, 7), (10, 7), (30, 6)):
        patch((x, 34), 0.0, (2, along), TURN)
    patch((40, -22), -0.9, (2, 5), TURN)
    text = "schema: tactile_cdma/layout\nversion: 1\nshape: list\npitch_mm: 9\ntaxels:\n"
    with TemporaryDirectory() as folder:
        path = Path(folder) / "hand.yaml"
        path.write_text(text + "\n".join(rows) + "\n", encoding="utf-8")
        return read_layout(path, Wiring())


def draw_contacts() -> Figure:
    """Contacts on a hand: forces at their centres of pressure, and the resultant."""
    layout = hand_layout()
    cover = Foundation(layout.positions_m, layout.normals, layout.areas_m2)
    radius_m = 0.016
    places = {18: 1.4e-3, 73: 2.4e-3, 87: 1.8e-3, 113: 3e-3, 124: 2e-3}
    balls = [
        Sphere(radius_m=radius_m, position_m=tuple(at + normal * (radius_m - depth_m)))
        for at, normal, depth_m in (
            (layout.positions_m[taxel], layout.normals[taxel], depth_m)
            for taxel, depth_m in places.items()
        )
    ]
    pressure_pa = cover.pressure_pa(balls).astype(np.float32)
    tracker = ContactTracker(layout, SkinConfig.of({}).contact)
    status = np.zeros(len(layout), np.uint8)
    contacts = tracker.update(Readings(pressure_pa, pressure_pa, status), 0.0)
    figure = style.sheet(560)
    figure.set_layout_engine("none")
    axes = figure.add_axes((-0.1, -0.1, 1.2, 1.2), projection="3d")
    axes.computed_zorder = False
    faces = 1e3 * layout.squares_m[:, [0, 1, 2, 5]]
    shades = colours(pressure_pa, MAX_PA) / 255
    axes.add_collection3d(Poly3DCollection(faces, facecolors=shades, edgecolors="white", lw=0.6))
    for one in contacts.contacts:
        _arrow(axes, one.position, one.force, f"{np.linalg.norm(one.force):.1f} N", style.BLUE)
    total = contacts.wrench[:3]
    text = f"resultant {np.linalg.norm(total):.1f} N"
    _arrow(axes, contacts.centre_m, total, text, style.ORANGE, (14.0, 0.0, 24.0))
    axes.set(xlim=(-50, 75), ylim=(-40, 95), zlim=(0, 45))
    axes.set_box_aspect((125, 135, 45), zoom=1.15)
    axes.view_init(38, -60)
    axes.set_axis_off()
    return figure


def _arrow(
    axes: Axes,
    at_m: Floats,
    force_n: Floats,
    text: str,
    colour: str,
    aside_mm: tuple[float, float, float] = (0.0, 0.0, 3.0),
) -> None:
    """Draw a force that ends where it acts, longer with its size, with a text beside its begin."""
    size_n = float(np.linalg.norm(force_n))
    reach = (20 + 4 * size_n) * force_n / size_n
    begin = 1e3 * at_m - reach
    axes.quiver(*begin, *reach, color=colour, lw=3, arrow_length_ratio=0.25, zorder=5)
    label = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    axes.text(*(begin + aside_mm), text, color=colour, ha="center", size=15, zorder=6, bbox=label)


def draw_rates() -> Figure:
    """Fastest frame rate against nodes, by the kind of the nodes."""
    figure = style.sheet(430)
    axes = figure.subplots()
    counts = np.unique(np.geomspace(4, 1000, 60).astype(int))
    names = {"tiny": "tiny: ATtiny85", "slow": "slow: ATmega328P", "fast": "fast: with crystal"}
    for kind, colour, marker in zip(KINDS, style.CYCLE, style.MARKERS, strict=False):
        found = [(n, fastest_hz(int(n), kind)) for n in counts]
        nodes, hertz = zip(*((n, rate) for n, rate in found if rate), strict=True)
        axes.loglog(nodes, hertz, color=colour, marker=marker, markevery=8, label=names[kind])
    axes.axhline(50, color=style.BLACK, lw=1, ls="--")
    axes.annotate("50 Hz", (4.1, 52), va="bottom")
    axes.set_xticks([4, 16, 64, 256, 900], ["4", "16", "64", "256", "900"])
    axes.set_xticks([], minor=True)
    axes.set_yticks([2, 10, 100, 500], ["2", "10", "100", "500"])
    axes.set(xlabel="nodes", ylabel="frames per second", title="Fastest frames of 10-bit words")
    axes.legend()
    return figure


def fastest_hz(nodes: int, kind: str) -> float:
    """Return the highest frame rate of so many scrambled nodes of a kind; 0: they cannot."""
    spec = FrameSpec(nodes=nodes, scramble=True, chip_s=1e-7, frame_period_s=10.0)
    return max((frames.fastest_hz for frames in frames_of(spec, kind)), default=0.0)


FAULTS = {
    "sound line": Line(),
    "noise, ρ 6": Line(noise_v=0.224),
    "hum of 2 A": Line(hum_v=0.6),
    "impulses, 5 V": Line(impulses_hz=50, impulse_v=5, impulse_chips=2),
    "jumps of 2 A": Line(steps_hz=100, step_v=0.6),
    "slow edges": Line(low_pass_chips=0.6),
    "a node 0.6 chip late": Line(late=((2, 0.6),)),
    "a node 2 chips late": Line(late=((2, 2.0),)),
    "a node 0.5 % slow": Line(slow=((2, 0.005),)),
    "a node drops out": Line(dropouts=((2, 0.5),)),
    "a node at 4 A": Line(gains=((2, 4.0),)),
    "offset at the rail": Line(offset_v=5.4),
}
"""Disturbances of `make bench-doubt`, by a name that a reader knows."""


def draw_clauses() -> Figure:
    """What puts frames in doubt, by disturbance and clause."""
    figure = style.sheet(560)
    axes = figure.subplots()
    kinds = {"certain": style.PALE}
    kinds |= {
        clause.name.lower(): colour for clause, colour in zip(Clause, style.CYCLE, strict=False)
    }
    kinds |= {"rejected": style.BLACK}
    left = np.zeros(len(FAULTS))
    counted = {name: clauses_of(line) for name, line in FAULTS.items()}
    for kind, colour in kinds.items():
        share = np.array([100 * count[kind] / count.total() for count in counted.values()])
        axes.barh(list(FAULTS), share, left=left, color=colour, label=kind, height=0.75)
        left += share
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set(xlabel="share of the frames, %", xlim=(0, 100))
    figure.legend(loc="outside upper center", ncols=7, columnspacing=1.0, handlelength=1.0)
    return figure


def clauses_of(line: Line, frames: int = 200) -> Counter[str]:
    """Count the frames of a line: certain, or by the clause that is farthest beyond its limit."""
    found: Counter[str] = Counter()
    recording = render(Skin(), FEW, line, Digitizer(), frames, 1)
    for frame, _ in play(recording):
        proof = frame.certificate
        doubted = proof is not None and not proof.holds
        found[proof.weakest.name.lower() if proof and doubted else "certain"] += 1
    found["rejected"] = max(0, frames - found.total())
    return found


def draw_body() -> Figure:
    """The patches of config/big_body.yaml, and the wire from the clock's GPIO16 to GPIO17s."""
    body = Body(ROOT / "config" / "big_body.yaml")
    figure = style.sheet(620)
    space = figure.add_subplot(1, 2, 1, projection="3d")
    wires = figure.add_subplot(1, 2, 2)
    for number, (name, part) in enumerate(body.parts.items()):
        drives = body.skins[name].config.sync == DRIVES
        colour, y = style.ORANGE if drives else style.BLUE, -number
        space.scatter(*body.positions_m[part].T, color=colour, s=3, depthshade=False)
        wires.plot([0.3, 2.2], [y, y], "s-", color=style.GREY, ms=9, lw=1)
        wires.text(0.22, y, name.replace("_", " "), ha="right", va="center", color=colour)
        wires.plot([2.2], [y], "s", color=colour, ms=14)
        wires.plot([2.2, 3.0], [y, y], color=style.ORANGE)
        wires.text(2.35, y + 0.12, "16" if drives else "17", fontsize=10)
    wires.plot([3.0, 3.0], [0, 1 - len(body.parts)], color=style.ORANGE)
    for x, text in ((0.3, "72\nnodes"), (2.2, "Pico"), (3.0, "clock")):
        wires.text(x, 0.8, text, ha="center")
    wires.set(xlim=(-1.7, 3.4), ylim=(0.2 - len(body.parts), 1.9))
    wires.axis("off")
    space.view_init(elev=12, azim=38)
    space.set_aspect("equal")
    space.set(xticks=(-0.1, 0.1), yticks=(-0.2, 0, 0.2), xlabel="x, m", ylabel="y, m")
    return figure


REDRAWN = {
    "pareto": "benchmarks.pareto",
    "pressure": "benchmarks.pressure",
    "skip": "benchmarks.skip",
    "sparse": "benchmarks.sparse.__main__",
    "timing": "benchmarks.timing",
    "doubt": "benchmarks.doubt.bench",
}
"""Benchmarks whose pictures are drawn from kept tables alone, and their modules; timing and doubt
keep theirs from their next full run on."""
DRAWINGS: dict[str, Callable[[], Figure]] = {
    "curve": draw_curve,
    "frame": draw_frame,
    "messages": draw_messages,
    "contacts": draw_contacts,
    "rates": draw_rates,
    "clauses": draw_clauses,
    "big-body": draw_body,
}


def main() -> int:
    names = sys.argv[1:] or [*DRAWINGS, "heatmap"]
    for name in names:
        path = IMAGES / f"{name}.png"
        if name == "heatmap":
            layout, pressure_pa, _, _ = pressed(dead=False)
            Image.fromarray(heatmap(pressure_pa, layout, MAX_PA, PIXELS)).save(path)
            style.shrink(path)
        elif name in REDRAWN:
            style.save(import_module(REDRAWN[name]).picture(RESULTS[name]["tables"]), path)
        else:
            style.save(DRAWINGS[name](), path)
        print(path.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
