# SPDX-License-Identifier: Apache-2.0

"""Draws docs/img/paper.png, and prints the table of docs/paper.md."""

from __future__ import annotations

from collections import Counter

from matplotlib.axes import Axes

from .. import style
from ..report import QUICK, Report
from . import scaling, sensor, words
from .claims import VERDICTS
from .waves import Waves

PANELS = ["3b 6a", "6b 6c", "7a 7b", "7c latency", "8(c) 8(d)", "wires time"]
OF_THE_PAPER = 10
"""Panels that are figures of the paper, or show a claim of its title."""
SLOTS = "nodes of equal amplitude", "both fill the converter's range"
HEADERS = ["section, figure", "what", "paper", "here", "verdict"]


def main() -> None:
    report = Report("paper", "The paper's figures and claims")
    if not QUICK:
        words.write(words.CAPTURE)
    waves, heard = Waves(), words.Words()
    claims = [*scaling.claims(), *sensor.claims(), *waves.claims(), *heard.claims()]
    report.table(HEADERS, [claim.row for claim in claims])
    by_size = [scaling.ways(nodes) for nodes in scaling.SIZES]
    report.table(
        ["wires; ms to read all", *(f"{nodes} nodes" for nodes in scaling.SIZES)],
        [[name, *(_found(ways[name]) for ways in by_size)] for name in by_size[0]],
    )
    gains = [scaling.over_time_slots_db(nodes) for nodes in scaling.SIZES]
    report.table(
        ["ρ over that of time slots, dB", *(f"{nodes} nodes" for nodes in scaling.SIZES)],
        [
            [name, *(f"{gain:+.1f}" for gain in row)]
            for name, row in zip(SLOTS, zip(*gains, strict=True), strict=True)
        ],
    )
    figure = style.sheet(1700)
    axes: dict[str, Axes] = figure.subplot_mosaic([row.split() for row in PANELS])
    sensor.draw(axes["6a"], axes["6b"], axes["6c"])
    waves.draw(axes["3b"], axes["7a"], axes["7b"], axes["7c"])
    heard.draw({figure: axes[figure] for figure in words.PRESSED})
    scaling.draw(axes["latency"], axes["wires"], axes["time"])
    counts = Counter(claim.verdict for claim in claims)
    verdicts = {name.replace(" ", "_"): counts[name] for name in VERDICTS}
    report.finish(figure, figures=OF_THE_PAPER, **verdicts)


def _found(way: tuple[int, float] | None) -> str:
    return "–" if way is None else f"{way[0]}; {1e3 * way[1]:.3g}"


if __name__ == "__main__":
    main()
