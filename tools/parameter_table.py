# SPDX-License-Identifier: Apache-2.0

"""Writes docs/parameters.md: the driver's parameters, and rates by nodes; --check only compares."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from tactile_cdma.code.frame import ORTHOGONAL, SPARSE, FrameSpec
from tactile_cdma.config.frame_rate import frames_of
from tactile_cdma.config.parameters import BY_NAME, FAST, KINDS, PARAMETERS, SLOW, Parameter

PAGE = Path(__file__).resolve().parents[1] / "docs" / "parameters.md"
BEGIN, END = "<!-- {}: written by tools/parameter_table.py -->", "<!-- end of {} -->"
SKINS = [(16, 0), (40, 0), (64, 0), (256, 0), (900, 0), (4000, 912)]
"""Nodes; chips of sparse codes, or 0."""
USUAL_S = 0.02
"""Period of a rate that a control loop asks for, s."""
EVERYDAY = {
    "port": "Where the digitizer is: `/dev/ttyACM0`, `usb://SERIAL`, `sim://?scene=hand`, "
    "`replay://FILE`; empty, the skin is simulated, with a warning.",
    "nodes": "How many nodes are on the wire.",
    "rate_hz": "How many frames per second you want: the driver chooses chips and period "
    "([rates](#rates)), and refuses what your nodes cannot do; 0: `chip_us` counts.",
    "node_kind": "Which nodes `rate_hz` is for.",
    "layout_file": "Where the taxels are ([layout](patches.md#layout-where-the-taxels-are)); "
    "empty: on a flat grid.",
    "pitch_mm": "How far apart the taxels of the grid are; two numbers: columns, rows.",
    "calibration_file": "The taxels' curves, from `tactile-cdma calibrate`; empty: all have the "
    "[two-stage curve](#the-sensors-curve).",
    "contact_kpa": "From which pressure on a touch is a contact.",
    "masked": "Which nodes are out of service, `3, 7`, so that they make nothing unknown.",
    "frame_id": "Which tf frame the readings are in.",
}
"""The parameters of the first day, and what each says there."""
GROUPS = {
    "Port": "digitizer_id baud",
    "Frames on the wire": "bits parity chip_us frame_period_ms codes order first_row sign_seed "
    "scramble resync_chips guard_chips",
    "Line and digitizer": "drive polarity amplitude_mv timing sync sync_wire samples_per_chip "
    "vref_v",
    "Nodes": "nodes_repeat active_share stale_after_s dead_share",
    "The sensor's curve": "v0_v knee_kpa range_kpa sensitivity1_v_per_kpa sensitivity2_v_per_kpa",
    "Rest, drift, contacts": "skin drift_pa_per_min state_folder release_kpa",
    "Places": "rows columns taxel_mm parent_frame mount_xyz_m mount_rpy_rad",
    "What is published": "publish_voltage publish_sigma publish_unknown_wrench idle_rate_hz "
    "autostart",
    "Pictures": "visual_rate_hz colour_max_kpa colour_gamma heatmap_pixels",
}
"""The other parameters, by purpose."""


def row(parameter: Parameter, text: str) -> str:
    default = str(parameter.default)
    if isinstance(parameter.default, bool):
        default = default.lower()
    elif isinstance(parameter.default, tuple):
        default = str(list(parameter.default))
    elif parameter.default == "":
        default = '""'
    allowed = ", ".join(f"`{choice}`" for choice in parameter.choices)
    if parameter.limits:
        low, high = parameter.limits
        allowed = f"{low:.10g}…{high:.10g} {parameter.unit}".strip()
    live = " •" if parameter.live else ""
    values = f"`{default}`" + (f"; {allowed}" if allowed else "")
    return f"- `{parameter.name}`{live} ({values}): {text}"


def lists() -> list[str]:
    """Return the lines of both lists; raises KeyError for a parameter that has no place."""
    others = {title: names.split() for title, names in GROUPS.items()}
    placed = [*EVERYDAY, *(name for names in others.values() for name in names)]
    if sorted(placed) != sorted(BY_NAME):
        raise KeyError(f"in no group, or in two: {set(BY_NAME) ^ set(placed) or placed}")
    lines = ["## Ten for every day", *(row(BY_NAME[n], text) for n, text in EVERYDAY.items())]
    for title, names in others.items():
        members = [parameter for parameter in PARAMETERS if parameter.name in names]
        lines += ["", f"## {title}", *(row(parameter, parameter.text) for parameter in members)]
    return lines


def rates_of(nodes: int, chips: int) -> str:
    """Return the rates of a skin with scrambled words of 10 bits, as the driver finds them."""
    codes = SPARSE if chips else ORTHOGONAL
    spec = FrameSpec(
        nodes=nodes, order=chips, codes=codes, scramble=True, chip_s=1e-7, frame_period_s=10.0
    )
    cells, usual = [f"{nodes}, sparse" if chips else f"{nodes}"], "–"
    for kind in KINDS:
        if not (frames := [*frames_of(spec, kind)]):
            cells.append("–")
            continue
        shortest = frames[-1]
        latency_ms = shortest.spec.frame_s / 2 * 1e3
        latency = f"{latency_ms:.0f}" if latency_ms >= 10 else f"{latency_ms:.2g}"
        cells.append(f"{shortest.spec.chip_s * 1e6:g}/{shortest.fastest_hz:.3g}/{latency}")
        if kind in (SLOW, FAST) and usual == "–":
            fits = next((f for f in frames if f.room_s <= USUAL_S + 1e-9), None)
            usual = f"{fits.spec.chip_s * 1e6:g}, {kind}" if fits else usual
    return " ".join(["|", " | ".join([*cells, usual]), "|"])


def rates() -> Iterator[str]:
    """Yield the lines of the table of rates."""
    yield from ("| nodes | tiny | slow | fast | at 50 Hz |", "|---|---|---|---|---|")
    yield from (rates_of(*skin) for skin in SKINS)


def with_tables(text: str) -> str:
    """Return the page's text with lists and table replaced by the current ones."""
    for name, lines in (("parameters", lists()), ("rates", rates())):
        before, rest = text.split(BEGIN.format(name))
        _, after = rest.split(END.format(name))
        text = "\n".join([before + BEGIN.format(name), *lines, END.format(name) + after])
    return text


def main() -> int:
    text = PAGE.read_text(encoding="utf-8")
    if "--check" in sys.argv:
        return int(with_tables(text) != text)
    PAGE.write_text(with_tables(text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
