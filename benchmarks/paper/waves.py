# SPDX-License-Identifier: Apache-2.0

"""Figures 3(b) and 7: what a node sends, by the code book and at the pin of its emulated image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from amplifier import FrontEnd, design
from check import PARAMS, on_virtual_board
from emulated import EmulatedNodes
from figures import share_at_rest
from ngspice import waveform
from scope import SENSOR_V, pulses
from skin import Spread, reference_nodes
from tactile_cdma.code.codes import code_book
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import rows_of
from tactile_cdma.config.frame_rate import FAST, HEARS_DATA_NS
from tactile_cdma.config.parameters import DATA, LINE, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.node_memory import usual_heartbeat

from .claims import (
    ASSERTED,
    DIFFERS,
    MET,
    NOT_COMPARABLE,
    OF_PAPER,
    THIS,
    Claim,
    at_most,
    equals,
    given,
    keeps,
)

SKIN = Path(__file__).resolve().parents[2] / "config" / "paper_skin.yaml"
WARM_UP_FRAMES = 20
"""Frames until nodes have learnt their code at rest and the period."""
CLOCK_ERROR = 0.02
"""Error of the slowest and of the fastest of the nodes' clocks."""
FRAMES = 3
"""Frames of the nodes that transmit: figure 7."""
ONE_WIRE_FRAMES = 40
"""Frames of the nodes on one wire. Chosen: half a second."""
PAPER_TWO_CHIPS_S = 104.3e-6
PAPER_LONGEST_S = 8.8e-3
PAPER_PERIOD_MS = 12.8
SYNCED = "emulated, disciplined by sync pulses"
MINIMAL = 0.05
"""Share of a level up to which crosstalk is minimal. Chosen: a tenth of that of a word."""
SPEAKERS, DRAWS = (8, 15), 16
"""Numbers of nodes that speak at once, each in so many frames of random words, for crosstalk."""
LESS = 0.5
"""Share of its current up to which a node takes less power. Chosen: half."""
SHOWN = 10
"""The node, counted from 0, that is drawn: 11, as in figure 8."""
REST_CHIPS = 20
"""Chips after a frame, at the end of which the line is at rest."""
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


def node_frames(config: SkinConfig, threshold: int = 0, count: int = FRAMES) -> list[list[Frame]]:
    """So many frames in a row of the paper skin's nodes, disciplined by the sync line.

    threshold: of the nodes, which are at rest unless it is 0. The firmware has no mode in which
    nodes transmit without a sync pulse.
    """
    period_ns = round(config.spec.frame_period_s * 1e9)
    spread = Spread(clock=CLOCK_ERROR, supply=0.0)
    with EmulatedNodes(reference_nodes(config, spread, threshold=threshold)) as nodes:
        nodes.press(SENSOR_V)
        for frame in range(1, WARM_UP_FRAMES + count + 1):
            for rise, fall in pulses(config) * 1e9:
                nodes.sync(frame * period_ns + round(rise), True)
                nodes.sync(frame * period_ns + round(fall), False)
            nodes.run((frame + 1) * period_ns - 1_000_000)
        since_ns = (WARM_UP_FRAMES + 1) * period_ns
        return [
            [
                _cut(nodes.edges(node), since_ns + frame * period_ns, period_ns)
                for frame in range(count)
            ]
            for node in range(len(nodes.nodes))
        ]


def data_wires() -> int:
    """Count the wires beside supply and ground of 16 emulated nodes with pulses on the data wire.

    A second one is needed where any of their words is wrong, or a sample lost.
    """
    config = SkinConfig.of(read_file(PARAMS) | {"sync_wire": DATA})
    trial, _ = on_virtual_board(config, "atmega328p", ONE_WIRE_FRAMES)
    return 1 + bool(trial.wrong or trial.lost_samples)


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
        self.crosstalk = _crosstalk(self.front, self.spec)
        self.idle_frames = usual_heartbeat(self.spec.frame_period_s)
        idle = node_frames(self.config, threshold=1, count=self.idle_frames)
        self.idle_spoken = sum(frame.times_s.size > 0 for row in idle for frame in row)
        self.idle_current = {mcu: share_at_rest(mcu) for mcu in ("atmega328p", FAST)}

    def chips_s(self, count: int) -> NDArray[np.float64]:
        """Durations of all levels that last for so many chips, s."""
        return np.concatenate(
            [frame.runs_s[self._chips_of(frame) == count] for row in self.frames for frame in row]
        )

    def _chips_of(self, frame: Frame) -> NDArray[np.float64]:
        """Whole chips that each level of a frame lasts."""
        return np.round(frame.runs_s / self.spec.chip_s)

    def claims(self) -> list[Claim]:
        """Section IV.B, and the wire of the abstract."""
        chip_s = self.spec.chip_s
        lasts_s = np.array([f.times_s[-1] - f.times_s[0] for row in self.frames for f in row])
        off = np.abs(self.chips_s(1) / chip_s - 1).max()
        two_s = self.chips_s(2)
        worst_s = two_s[np.abs(two_s - 2 * chip_s).argmax()]
        period_ms = 1e3 * self.spec.frame_period_s
        emulated = [
            (
                "7(a)",
                "frame of a node, ms",
                "8…8.8",
                f"{1e3 * lasts_s.min():.4f}…{1e3 * lasts_s.max():.4f}",
            ),
            ("7(b)", "error of a chip's duration, %", "10", f"{100 * float(off):.3g}"),
            ("7(c)", "two chips, µs", f"{1e6 * PAPER_TWO_CHIPS_S:.1f}", f"{1e6 * worst_s:.1f}"),
        ]
        return [
            at_most(
                "abstract",
                f"data wires, sync included, chips of {HEARS_DATA_NS / 1e3:g} µs and more",
                1,
                data_wires(),
                "`make firmware-test SYNC=data`",
                "words on it are wrong",
            ),
            *(
                Claim(where, what, paper, here, THIS, NOT_COMPARABLE, SYNCED)
                for where, what, paper, here in emulated
            ),
            given("7(a)", "frame period, ms", PAPER_PERIOD_MS, period_ms, THIS, 0.0, "a parameter"),
            equals(
                "7(a)",
                "pulse amplitude, 2A, mV",
                300.0,
                2e3 * self.front.amplitude_v,
                "`make amplifier`",
                0.01,
                "bipolar; all 16 at once have to fit a converter's 3.3 V",
            ),
            Claim(
                "7(b)",
                "switching time, µs",
                "0.1…0.2",
                f"{1e6 * self.step_s:.3g}",
                THIS,
                NOT_COMPARABLE,
                "10 to 90 %, by SPICE, behind the converter's filter",
            ),
            keeps(
                "IV.C",
                f"crosstalk by SPICE, % of a node's level: worst of {crosstalk_frames(self.spec)} "
                f"frames of 1, {' or '.join(map(str, SPEAKERS))} speakers",
                "minimal",
                100 * self.crosstalk,
                100 * MINIMAL,
                THIS,
                f"at most {100 * MINIMAL:g} was chosen",
            ),
            keeps(
                f"IV.C{ASSERTED}",
                f"frames of untouched nodes, of {self.idle_frames * self.spec.nodes:,} in a second",
                "inactive",
                self.idle_spoken,
                0,
                THIS,
                "a node at rest speaks once a second; one held pressed speaks in every frame",
            ),
            Claim(
                f"IV.C{ASSERTED}",
                "current of a node at rest, % of that when it transmits, by data sheets",
                "less power",
                "; fast nodes ".join(f"{100 * share:.3g}" for share in self.idle_current.values()),
                "`make firmware-figures`",
                DIFFERS if max(self.idle_current.values()) > LESS else MET,
                f"at most {100 * LESS:g} was chosen",
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
            frames.step(1e3 * times_s, level_mv * levels, "C0", where="post", lw=0.5)
            for end_s in (self.spec.span_chips * self.spec.chip_s, PAPER_LONGEST_S):
                frames.axvline(1e3 * (start_s + frame.times_s[0] + end_s), **OF_PAPER)
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
            axes.axvline(cursor_us, color="C1", ls="--", lw=0.8)
        if chips == 2:
            axes.axvline(1e6 * PAPER_TWO_CHIPS_S, **OF_PAPER)
        axes.set_xlim(-120, 220)
        axes.set(title=f"{name}, emulated: {times_us[at + 1]:.1f} µs", xlabel="µs", ylabel="mV")


def _draw_example(axes: Axes) -> None:
    row = code_book(8).rows([EXAMPLE_NODE - 1])[0]
    bits = [1 if bit == "1" else -1 for bit in EXAMPLE_BITS]
    axes.step(np.arange(17), np.append(np.outer(bits, row).ravel(), 0), where="post", lw=1)
    for number, bit in enumerate(EXAMPLE_BITS):
        axes.axvspan(8 * number, 8 * number + 8, alpha=0.08 + 0.08 * number)
        axes.annotate(f"bit {bit}", (8 * number + 3, 1.1), fontsize=11)
    axes.set_ylim(-1.3, 1.4)
    axes.set(title=f"3(b) node {EXAMPLE_NODE} of eight sends {EXAMPLE_BITS}", xlabel="chip")


def crosstalk_frames(spec: FrameSpec) -> int:
    """Return the number of frames of crosstalk: each node alone, and DRAWS of each of SPEAKERS."""
    return spec.nodes + DRAWS * len(SPEAKERS)


def _crosstalk(front: FrontEnd, spec: FrameSpec) -> float:
    """Return the most that speakers leave on a silent node's row, over their level, in SPICE."""
    rng = np.random.default_rng(SHOWN)
    alone = np.eye(spec.nodes, dtype=bool)
    several = [rng.permutation(spec.nodes) < count for count in SPEAKERS for _ in range(DRAWS)]
    shares = list[float]()
    for active in [*alone, *several]:
        rows = row_levels_v(front, spec, rng.integers(0, 2**spec.bits, spec.nodes), active)
        shares.append(float(rows[:, ~active].max() / rows[:, active].mean()))
    return max(shares)


def row_levels_v(
    front: FrontEnd, spec: FrameSpec, codes: NDArray[np.int64], active: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return what is on the rows of the nodes in every bit of a frame in SPICE, (k, n), V ≥ 0."""
    chips = line_chips(spec, codes, active, amplitude_v=1 / spec.nodes)  # the mean of all pins
    end_s = (chips.size + REST_CHIPS) * spec.chip_s
    times_s, volts = waveform(front, chips.reshape(1, -1).astype(np.float64), spec.chip_s, end_s)
    edges_s = np.linspace(0, end_s, chips.size + REST_CHIPS + 1)
    areas = np.interp(
        edges_s,
        times_s,
        np.concatenate(([0], np.cumsum((volts[1:] + volts[:-1]) / 2 * np.diff(times_s)))),
    )
    levels = np.diff(areas) / spec.chip_s
    line = (levels[: chips.size] - levels[-1]).reshape(chips.shape)
    return np.abs(rows_of(line.astype(np.float32), spec)[..., spec.rows])


def _step_s(front: FrontEnd, chip_s: float) -> float:
    """Return the time from 10 to 90 % of a node's step at the converter, s, in SPICE."""
    levels = np.repeat([[-1.0], [1.0]], 8, axis=0).reshape(1, -1) / front.nodes  # mean of all pins
    times_s, volts = waveform(front, levels, chip_s, levels.size * chip_s)
    middle = np.searchsorted(times_s, 8 * chip_s)
    before, after = volts[middle - 1], volts[-1]
    share = (volts[middle:] - before) / (after - before)
    at = [times_s[middle + int(np.argmax(share >= level))] for level in (0.1, 0.9)]
    return float(at[1] - at[0])
