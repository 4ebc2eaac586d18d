# SPDX-License-Identifier: Apache-2.0

"""The paper's decoded examples, through the whole analog chain and the command line.

Liu et al., arXiv 2509.10888, section IV.C: node 11 alone, and nodes 4 and 13 together, on the
16-node board with order 16, 50 µs chips stretched to 8.0…8.8 ms per frame, every 12.8 ms, 300 mV
per node after an inverting amplifier, recorded by an oscilloscope.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.commands.cli import main
from tactile_cdma.sim.channel import Channel
from test.support.simulated import scope_capture

PAPER = FrameSpec(order=16, first_row=0, sign_seed=None, polarity=-1)
SCOPE = Channel(offset_v=0.02, noise_rms_v=0.01, stretch=0.10, adc_bits=8)
OPTIONS = [
    *("--timing", "gap", "--nodes", "16", "--bits", "10", "--chip-us", "50", "--order", "16"),
    *("--drive", "bipolar", "--polarity", "-1", "--frame-period-ms", "12.8"),
    *("--natural-signs", "--first-row", "0", "--vref", "3.3", "--json"),
]
FRAMES = 12


def record(path: Path, words: dict[int, str], rate_hz: float, seed: int) -> None:
    """A scope's CSV of FRAMES frames in which nodes (counted from 1) send words."""
    codes, active = np.zeros(16, dtype=np.int64), np.zeros(16, dtype=bool)
    for node, bits in words.items():
        codes[node - 1], active[node - 1] = int(bits, 2), True
    time_s, volts = scope_capture(PAPER, [(codes, active)] * FRAMES, rate_hz, SCOPE, seed=seed)
    lines = [f"{t:+.6E},{v:+.5E}" for t, v in zip(time_s - 0.05, volts, strict=True)]
    path.write_text("x-axis,1\nsecond,Volt\n" + "\n".join(lines) + "\n")


@pytest.mark.parametrize("rate_hz", [200e3, 500e3])
@pytest.mark.parametrize(
    ("words", "volts"),
    [
        ({11: "0101101110"}, {11: 1.18}),
        ({4: "1000110000", 13: "1010011001"}, {4: 1.80, 13: 2.14}),
    ],
    ids=["node 11", "nodes 4 and 13"],
)
def test_the_papers_three_words_decode_as_printed(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: dict[int, str],
    volts: dict[int, float],
    rate_hz: float,
) -> None:
    path = tmp_path / "scope.csv"
    record(path, words, rate_hz, seed=len(words))
    assert main(["decode", str(path), *OPTIONS]) == 0
    frames = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(frames) == FRAMES
    for number, frame in enumerate(frames):
        assert {node["node"]: node["bits"] for node in frame["nodes"]} == words
        assert {node["node"]: round(node["voltage"], 2) for node in frame["nodes"]} == volts
        assert frame["t"] == pytest.approx(-0.05 + 1e-3 + number * 12.8e-3, abs=5e-6)
        assert all(node["code"] == int(node["bits"], 2) for node in frame["nodes"])
        assert all(node["snr_db"] > 20 for node in frame["nodes"])
        assert all(0 < node["pressure_pa"] < 140e3 for node in frame["nodes"])
