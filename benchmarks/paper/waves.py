# SPDX-License-Identifier: Apache-2.0

"""Figures 3(b) and 7: what a node sends, by the code book and at the pin of its emulated image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from amplifier import FrontEnd, design
from emulated import EmulatedNodes
from ngspice import waveform
from scope import SENSOR_V, pulses
from skin import Spread, reference_nodes
from tactile_cdma.code.codes import code_book
from tactile_cdma.config.parameters import LINE, read_file
from tactile_cdma.config.skin_config import SkinConfig

from .claims import Claim, at_most, equals

COMMAND = "`make paper`"
SKIN = Path(__file__).resolve().parents[2] / "config" / "paper_skin.yaml"
WARM_UP_FRAMES = 20
"""Frames until nodes have learnt their code at rest and the period."""
CLOCK_ERROR = 0.02
"""Error of the slowest and of the fastest of the nodes' clocks."""
FRAMES = 3
SHOWN = 10
"""The node, counted from 0, that is drawn: 11, as in figure 8."""
EXAMPLE_NODE, EXAMPLE_BITS = 6, "10"
"""Number of one of eight nodes, and the two bits that it sends. Chosen: a row of many edges."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Holds a node's frame: times, s, of its edges, and levels −1, 0 or 1 after them, (m,)."""

    times_s: NDArray[np.float64]
    levels: NDArray[np.int8]

    @property
    def runs_s(self) -> NDArray[np.float64]:
        """Return how long each level lasts, s: (m − 1,); the last edge releases the pin."""
        return np.diff(self.times_s)


def node_frames(config: SkinConfig) -> list[list[Frame]]:
    """FRAMES in a row of the paper skin's nodes, disciplined by the sync line: figure 7.

    The firmware has no mode in which nodes transmit without a sync pulse.
    """
    period_ns = round(config.spec.frame_period_s * 1e9)
    spread = Spread(clock=CLOCK_ERROR, supply=0.0)
    with EmulatedNodes(reference_nodes(config, spread, threshold=0)) as nodes:
        nodes.press(SENSOR_V)
        for frame in range(1, WARM_UP_FRAMES + FRAMES + 1):
            for rise, fall in pulses(config) * 1e9:
                nodes.sync(frame * period_ns + round(rise), True)
                nodes.sync(frame * period_ns + round(fall), False)
            nodes.run((frame + 1) * period_ns - 1_000_000)
        since_ns = (WARM_UP_FRAMES + 1) * period_ns
        return [
            [
                _cut(nodes.edges(node), since_ns + frame * period_ns, period_ns)
                for frame in range(FRAMES)
            ]
            for node in range(len(nodes.nodes))
        ]


def _cut(edges: NDArray[np.void], start_ns: int, period_ns: int) -> Frame:
    inside = edges[(edges["t_ns"] >= start_ns) & (edges["t_ns"] < start_ns + period_ns)]
    return Frame((inside["t_ns"] - start_ns) * 1e-9, inside["level"])


class Waves:
    """Holds the emulated nodes' frames, and a step at the converter."""

    def __init__(self) -> None:
        self.config = SkinConfig.of(read_file(SKIN) | {"timing": LINE})
        self.spec = self.config.spec
        self.front: FrontEnd = design(self.spec, self.config.samples_per_chip)
        self.frames = node_frames(self.config)
        self.step_s = _step_s(self.front, self.spec.chip_s)

    def chips_s(self, count: int) -> NDArray[np.float64]:
        """Durations of all levels that last for so many chips, s."""
        return np.concatenate(
            [frame.runs_s[self._chips_of(frame) == count] for row in self.frames for frame in row]
        )

    def _chips_of(self, frame: Frame) -> NDArray[np.float64]:
        """Whole chips that each level of a frame lasts."""
        return np.round(frame.runs_s / self.spec.chip_s)

    def claims(self) -> list[Claim]:
        """Section IV.B."""
        chip_s = self.spec.chip_s
        lasts_s = np.array([f.times_s[-1] - f.times_s[0] for row in self.frames for f in row])
        one_s, two_s = self.chips_s(1), self.chips_s(2)
        off = np.abs(one_s / chip_s - 1).max()
        worst_s = two_s[np.abs(two_s - 2 * chip_s).argmax()]
        starts_s = [np.array([f.times_s[0] for f in row]) for row in self.frames]
        jitter_s = max(float(np.ptp(starts)) for starts in starts_s)
        range_ms = f"{1e3 * lasts_s.min():.4f}…{1e3 * lasts_s.max():.4f}"
        return [
            Claim("7(a)", "frame of a node, ms", "8…8.8", range_ms, COMMAND, "exceeded"),
            equals("7(a)", "frame period, ms", 12.8, 1e3 * self.spec.frame_period_s, COMMAND, 1e-9),
            at_most("7(a)", "jitter of a node's frames, µs", 800.0, 1e6 * jitter_s, COMMAND),
            equals(
                "7(a)",
                "level of a node, mV",
                300.0,
                1e3 * self.front.amplitude_v,
                "`make amplifier`",
                0.01,
                "all 16 at once have to fit a converter's 3.3 V",
            ),
            at_most("7(b)", "error of a chip's duration, %", 10.0, 100 * float(off), COMMAND),
            at_most(
                "7(b)",
                "switching time, µs",
                0.2,
                1e6 * self.step_s,
                COMMAND,
                "10 to 90 %, by SPICE, behind a filter for the converter's 4 samples a chip",
            ),
            at_most(
                "7(c)", "error of two chips, %", 4.3, 100 * abs(worst_s / chip_s / 2 - 1), COMMAND
            ),
        ]

    def draw(self, example: Axes, frames: Axes, one: Axes, two: Axes) -> None:
        """Figures 3(b), 7(a), (b) and (c)."""
        _draw_example(example)
        level_mv = 1e3 * self.front.amplitude_v * self.spec.polarity
        period_s = self.spec.frame_period_s
        for number, frame in enumerate(self.frames[SHOWN][:2]):
            start_s = number * period_s
            times_s = np.concatenate(([0], frame.times_s, [period_s])) + start_s
            levels = np.concatenate(([0], frame.levels, [0]))
            frames.step(1e3 * times_s, level_mv * levels, where="post", lw=0.5)
        frames.set(title="7(a) frames of an emulated node", xlabel="ms", ylabel="mV on the line")
        for axes, chips, name in ((one, 1, "7(b) one chip"), (two, 2, "7(c) two chips")):
            self._draw_cursors(axes, chips, level_mv, name)

    def _draw_cursors(self, axes: Axes, chips: int, level_mv: float, name: str) -> None:
        """Draw a level that lasts for so many chips, with its neighbours, between two cursors."""
        frame, at = next(
            (row[0], int(places[1]))
            for row in self.frames
            if (places := np.flatnonzero(self._chips_of(row[0]) == chips)).size > 1
        )
        begin_s = frame.times_s[at]
        times_us = 1e6 * (frame.times_s - begin_s)
        axes.step(times_us, level_mv * frame.levels, where="post", lw=1)
        for cursor_us in (0.0, times_us[at + 1]):
            axes.axvline(cursor_us, color="tab:red", ls="--", lw=0.8)
        axes.set_xlim(-120, 220)
        axes.set(title=f"{name}: {times_us[at + 1]:.1f} µs", xlabel="µs")


def _draw_example(axes: Axes) -> None:
    row = code_book(8).rows([EXAMPLE_NODE - 1])[0]
    bits = [1 if bit == "1" else -1 for bit in EXAMPLE_BITS]
    axes.step(np.arange(17), np.append(np.outer(bits, row).ravel(), 0), where="post", lw=1)
    for number, bit in enumerate(EXAMPLE_BITS):
        axes.axvspan(8 * number, 8 * number + 8, alpha=0.08 + 0.08 * number)
        axes.annotate(f"bit {bit}", (8 * number + 3, 1.1), fontsize=8)
    axes.set_ylim(-1.3, 1.4)
    axes.set(title=f"3(b) node {EXAMPLE_NODE} of eight sends {EXAMPLE_BITS}", xlabel="chip")


def _step_s(front: FrontEnd, chip_s: float) -> float:
    """Return the time from 10 to 90 % of a node's step at the converter, s, in SPICE."""
    levels = np.repeat([[-1.0], [1.0]], 8, axis=0).reshape(1, -1)
    times_s, volts = waveform(front, levels, chip_s, levels.size * chip_s)
    middle = np.searchsorted(times_s, 8 * chip_s)
    before, after = volts[middle - 1], volts[-1]
    share = (volts[middle:] - before) / (after - before)
    at = [times_s[middle + int(np.argmax(share >= level))] for level in (0.1, 0.9)]
    return float(at[1] - at[0])
