# SPDX-License-Identifier: Apache-2.0

"""What `tactile-cdma decode` prints of nodes that may have spoken unheard.

Who spoke is known of an independent line, on which some of them are faint.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from benchmarks.line_packets import config_of, introduction, packets
from tactile_cdma.base.text import listed
from tactile_cdma.wire.packets import PacketWriter
from test.support.command_line import Printed
from test.support.independent_line import SILENT, Digitizer, Line, Recording, Skin, Talk, render

FRAMES = 12


@dataclass(frozen=True)
class Printing:
    """A file, how it is decoded, and when its frames began, s."""

    recording: Recording
    path: Path
    options: tuple[str, ...]

    def sent(self, t_s: float) -> set[int]:
        """Numbers of the nodes that spoke in the frame that began then."""
        chip_s = self.recording.skin.chip_s
        frame = min(self.recording.frames, key=lambda one: abs(one.start_chips * chip_s - t_s))
        assert abs(frame.start_chips * chip_s - t_s) < 100 * chip_s
        return set((np.flatnonzero(frame.codes != SILENT) + 1).tolist())


def scope(folder: Path, line: Line) -> Printing:
    digitizer = Digitizer(samples_per_chip=8, marked=False)
    recording = render(Skin(), Talk(), line, digitizer, FRAMES, 3)
    path = folder / "scope.csv"
    counts = np.concatenate([run.counts for run in recording.runs])
    t_s = (recording.runs[0].t_chips + np.arange(len(counts)) / 8) * recording.skin.chip_s
    volts = counts * digitizer.volts_per_count
    np.savetxt(path, np.column_stack((t_s, volts)), delimiter=",", fmt="%.9f")
    return Printing(recording, path, ("--timing", "gap", "--nodes", "16"))


def raw(folder: Path, line: Line) -> Printing:
    digitizer = Digitizer(samples_per_chip=4)
    recording = render(Skin(), Talk(), line, digitizer, FRAMES, 3)
    path, writer = folder / "line.raw", PacketWriter()
    told = writer.encode(introduction(config_of(recording.skin, digitizer), digitizer))
    path.write_bytes(2 * told + b"".join(data for *_, data in packets(recording, writer)))
    return Printing(recording, path, ())


SOME = range(0, 16, 3)


@pytest.mark.parametrize(
    ("made", "faint"),
    [(scope, SOME), (raw, SOME), (raw, range(16))],
    ids=["scope", "digitizer", "all of them"],
)
def test_who_spoke_unheard_is_printed_as_doubtful(
    tmp_path: Path, printed: Printed, made: Callable[[Path, Line], Printing], faint: range
) -> None:
    printing = made(tmp_path, Line(noise_v=0.02, gains=tuple((node, 0.2) for node in faint)))
    command = "decode", printing.path, "--amplitude-mv", 300, *printing.options
    shown, lines = printed(*command, "--json").out.splitlines(), printed(*command).out.splitlines()
    unheard = 0
    for frame, line in zip(map(json.loads, shown), lines, strict=True):
        doubtful = frame["doubtful_silence"]
        heard = {node["node"] for node in frame["nodes"]}
        missed = printing.sent(frame["t"]) - heard
        unheard += len(missed)
        assert missed <= set(doubtful) and not heard & set(doubtful)
        assert ("all silent" in line) == (not heard and not doubtful)
        assert line.endswith(f"silence doubtful: {listed(doubtful, 'node')}") == bool(doubtful)
    assert unheard > 5, "nothing was missed"
