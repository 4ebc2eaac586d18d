# SPDX-License-Identifier: Apache-2.0

"""Figure 8: single-point and multi-point pressing, as a simulated scope captures it, decoded."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from tactile_cdma.commands.cli import main as tactile_cdma
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.channel import Channel
from test.support.simulated import scope_capture

from .claims import DIFFERS, INPUT, THIS, Claim

ROOT = Path(__file__).resolve().parents[2]
SKIN, CAPTURE = ROOT / "config" / "paper_skin.yaml", ROOT / "examples" / "scope.csv"
PRESSED = {
    "8(c)": {11: ("0101101110", "1.18")},
    "8(d)": {4: ("1000110000", "1.80"), 13: ("1010011001", "2.14")},
}
"""Liu et al., section IV.C: words and V by node, counted from 1."""
SENT = "sent"
ROWS, COLUMNS = 4, 4
FRAMES, RATE_HZ = 2, 100e3
"""Frames of each word, and samples per second, in the capture."""
LINE = Channel(offset_v=0.02, noise_rms_v=0.01, stretch=0.10, adc_bits=8)
"""The scope's offset, noise and converter; the nodes' frames of 8 to 8.8 ms."""


def write(path: Path) -> None:
    """Write a capture of FRAMES of every scene, as a scope's CSV."""
    spec = SkinConfig.of(read_file(SKIN)).spec
    frames = []
    for words in PRESSED.values():
        codes, active = np.zeros(spec.nodes, np.int64), np.zeros(spec.nodes, bool)
        for node, (bits, _) in words.items():
            codes[node - 1], active[node - 1] = int(bits, 2), True
        frames += [(codes, active)] * FRAMES
    time_s, volts = scope_capture(spec, frames, RATE_HZ, LINE, seed=1)
    lines = [f"{t:.5f},{v:.3f}" for t, v in zip(time_s, volts, strict=True)]
    path.write_text("x-axis,1\nsecond,Volt\n" + "\n".join(lines) + "\n", encoding="ascii")


def decoded(path: Path) -> list[dict[str, Any]]:
    """Return frames of a capture, as `tactile-cdma decode --json` prints them."""
    with redirect_stdout(StringIO()) as printed:
        tactile_cdma(["decode", str(path), "--params", str(SKIN), "--json"])
    return [json.loads(line) for line in printed.getvalue().splitlines()]


class Words:
    """Holds the decoded capture."""

    def __init__(self, path: Path = CAPTURE) -> None:
        self.config = SkinConfig.of(read_file(SKIN))
        frames = decoded(path)
        self.scenes = {
            figure: frames[FRAMES * number : FRAMES * (number + 1)]
            for number, figure in enumerate(PRESSED)
        }

    def claims(self) -> list[Claim]:
        """Section IV.C."""
        found, others = [], 0
        for figure, words in PRESSED.items():
            heard = self.scenes[figure]
            for node, (bits, volts) in words.items():
                said = {
                    f"{n['bits']}; {n['voltage']:.2f}"
                    for frame in heard
                    for n in frame["nodes"]
                    if n["node"] == node
                }
                paper, here = f"{bits}; {volts}", " or ".join(said)
                verdict = INPUT if here == paper else DIFFERS
                what = f"node {node}: word; V"
                found.append(Claim(figure, what, paper, here, THIS, verdict, SENT))
            others += len({n["node"] for frame in heard for n in frame["nodes"]} - set(words))
        where, what, paper = ", ".join(PRESSED), "other nodes that speak", "minimal crosstalk"
        verdict, why = (DIFFERS if others else INPUT), "simulated without crosstalk"
        found.append(Claim(where, what, paper, f"{others}", THIS, verdict, why))
        return found

    def draw(self, axes: dict[str, Axes]) -> None:
        """Figures 8(c) and (d): pressures and words of the first frame."""
        for figure, panel in axes.items():
            kpa = np.zeros(ROWS * COLUMNS)
            for node in self.scenes[figure][0]["nodes"]:
                at = node["node"] - 1
                kpa[at] = 1e-3 * node["pressure_pa"]
                text = f"{node['bits'][:5]}\n{node['bits'][5:]}\n{node['voltage']:.2f} V"
                place, ink = (at % COLUMNS, at // COLUMNS), "white" if kpa[at] < 90 else "black"
                panel.annotate(text, place, ha="center", va="center", color=ink, fontsize=11)
            image = panel.imshow(kpa.reshape(ROWS, COLUMNS), cmap="inferno", vmin=0, vmax=140)
            panel.figure.colorbar(image, ax=panel, shrink=0.8, label="kPa")
            panel.set(title=f"{figure} decoded", xticks=[], yticks=[])
