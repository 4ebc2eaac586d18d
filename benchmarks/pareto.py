# SPDX-License-Identifier: Apache-2.0

"""CPU time per frame against bit error rate, for every way to decode one skin: `make bench-pareto`.

16 nodes send random words of 10 bits in every frame, on the line of independent_line.py with white
noise. ρ is the same for all, so that no receiver decides a single bit better than Q(ρ) = 10⁻³.
Measured is the whole pipeline on bytes in memory, from packets to readings, once it knows the
stream; words taken for silence and lost frames count as wrong in all bits.

- line, gap: frames marked by the digitizer, or found in the waveform.
- parity: one more bit per word, by which the weakest bit of a word is mended.
- late nodes: each node starts up to half a chip late; they are decoded as if none did.
- sparse codes: 64 chips, which tell 31 speakers of any number apart; here all 16 nodes are. In this
  noise every frame is in doubt.
- dense product: marked chips times the rows, and the signs; no amplitudes, doubts or readings.
  What it takes less is what everything else costs.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import time
from dataclasses import astuple, dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.line_packets import config_of, introduction, packets
from benchmarks.report import QUICK, Report
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.wire.messages import Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.independent_line import (
    SILENT,
    Digitizer,
    Ints,
    Line,
    Skin,
    Talk,
    Truth,
    render,
)

BOUND = 1e-3
RHO = -NormalDist().inv_cdf(BOUND)
"""√N·a/σ at which the matched filter's bit error rate Q(ρ) is BOUND."""
MOST_LATE_CHIPS = 0.5
"""Latest start of a late node, chips."""
WARM_UP = 40
"""Frames before those that count: timing by gaps has then learnt its raster."""
FRAMES, STREAMS = (60, 4) if QUICK else (200, 25)
RAIL_V = 12.0
"""Above 16 nodes of 0.3 V and six deviations of the noise at 8 samples per chip."""


@dataclass(frozen=True)
class Way:
    """Is one way to sample and decode the skin; the defaults are those of the parameters.

    late: nodes start late. sparse: codes are. dense: nothing but a product.
    """

    name: str
    samples_per_chip: int = 4
    timing: str = "line"
    order: int = 20
    parity: bool = False
    late: bool = False
    sparse: bool = False
    dense: bool = False

    @property
    def skin(self) -> Skin:
        bits = 10 + self.parity
        # The default's share of pause for all orders; 16 nodes need all rows of order 16.
        return Skin(
            order=self.order,
            first_row=min(1, self.order - 16),
            parity=self.parity,
            period_chips=round(1.28 * bits * self.order),
            sparse=self.sparse,
        )

    @property
    def digitizer(self) -> Digitizer:
        return Digitizer(
            samples_per_chip=self.samples_per_chip if self.samples_per_chip > 1 else 4,
            integrated=self.samples_per_chip == 1,
            marked=self.timing == "line",
            rail_v=RAIL_V,
            adc_bits=16,
        )

    @property
    def config(self) -> SkinConfig:
        return config_of(self.skin, self.digitizer)


DEFAULT = Way("line, 4 per chip")
WAYS = (
    *(replace(DEFAULT, name=f"line, {m} per chip", samples_per_chip=m) for m in (1, 2)),
    DEFAULT,
    Way("line, 8 per chip", 8),
    Way("gap, 4 per chip", timing="gap"),
    Way("gap, 8 per chip", 8, timing="gap"),
    Way("line, 1 per chip, parity", 1, parity=True),
    Way("line, 4 per chip, parity", parity=True),
    Way("line, 4 per chip, order 16", order=16),
    Way("line, 4 per chip, order 24", order=24),
    Way("line, 1 per chip, sparse codes", 1, order=64, sparse=True),
    Way("late nodes, 4 per chip", late=True),
    Way("dense product, 1 per chip", 1, dense=True),
    Way("dense product, 4 per chip", dense=True),
)


@dataclass(frozen=True)
class Stream:
    """Is what a digitizer sends, (host time in s, bytes); warm_up comes before what is measured.

    truths: of the frames that are measured.
    """

    way: Way
    warm_up: list[tuple[float, bytes]]
    reads: list[tuple[float, bytes]]
    truths: tuple[Truth, ...]


@dataclass(frozen=True)
class Outcome:
    """Holds what one way made of one stream.

    cpu_s: per frame. codes: (frames, n), SILENT where no word was heard. lost: frames.
    unflagged: wrong words that are not flagged as doubtful, missing ones included.
    """

    cpu_s: float
    codes: Ints
    bit_errors: int
    lost: int
    unflagged: int


def stream(way: Way, seed: int) -> Stream:
    """Render a stream: introduction and frames."""
    skin, rng = way.skin, np.random.default_rng([7, seed])
    delays = rng.uniform(0, MOST_LATE_CHIPS if way.late else 0.0, skin.nodes)
    noise_v = skin.amplitude_v * skin.order**0.5 / RHO
    line = Line(noise_v=noise_v, late=tuple(enumerate(delays)))
    writer = PacketWriter()
    warm_up = [(0.0, writer.encode(introduction(way.config, way.digitizer)))]
    recording = render(skin, Talk(), line, way.digitizer, WARM_UP + FRAMES, [seed, 2])
    reads: list[tuple[float, bytes]] = []
    begin = recording.frames[WARM_UP].start_chips - 1
    for t_chips, t_host, data in packets(recording, writer):
        (warm_up if t_chips < begin else reads).append((t_host, data))
    return Stream(way, warm_up, reads, recording.frames[WARM_UP:])


def measure(some: Stream) -> Outcome:
    """Decode a stream and compare it with the truth."""
    skin, config = some.way.skin, some.way.config
    decoder = DenseProduct(config) if some.way.dense else Pipeline(config)
    for t_host, data in some.warm_up:
        decoder.feed(data, t_host)
    frames: list[Any] = []
    begin_s = time.process_time()
    for t_host, data in some.reads:
        frames += decoder.feed(data, t_host)
    frames += decoder.flush()
    cpu_s = (time.process_time() - begin_s) / len(some.truths)
    sent = np.stack([truth.codes for truth in some.truths])
    starts = np.array([truth.start_chips for truth in some.truths])
    codes, flagged = np.full_like(sent, SILENT), np.zeros(sent.shape, bool)
    heard = np.zeros(len(sent), bool)
    for frame in frames:
        late = frame.t_start / skin.chip_s - starts
        number = int(np.argmin(np.abs(late)))
        if abs(late[number]) < skin.period_chips / 2:
            codes[number] = np.where(frame.words.active, frame.words.codes, SILENT)
            flagged[number], heard[number] = frame.words.doubtful, True
    bits = ((codes ^ sent)[..., None] >> np.arange(skin.bits) & 1).sum(axis=-1)
    bits[codes == SILENT] = skin.bits
    unflagged = (codes != sent) & ~flagged & heard[:, None]
    return Outcome(
        cpu_s, codes, int(bits.sum()), int(np.count_nonzero(~heard)), int(unflagged.sum())
    )


class DenseProduct:
    """Decodes marked frames of nodes that all speak by the least: one product, and its signs."""

    def __init__(self, config: SkinConfig) -> None:
        spec, self._per_chip = config.spec, config.samples_per_chip
        self._spec, self._parser = spec, PacketParser()
        self._rows = (spec.signs[:, None] * spec.node_rows).T.astype(np.float32)
        self._size = spec.chips * self._per_chip
        self._parts: list[np.ndarray] = []
        self._held, self._t_start = 0, 0.0

    def feed(self, data: bytes, _: float) -> list[DenseFrame]:
        """Return the frames that these bytes complete."""
        frames = []
        for packet in self._parser.feed(data):
            if not isinstance(packet, Samples):
                continue
            if packet.sync:
                self._parts, self._held = [], 0
                self._t_start = packet.device_time_us * 1e-6
            before, self._held = self._held, self._held + packet.counts.size
            self._parts.append(packet.counts)
            if before < self._size <= self._held:
                frames.append(self._frame(np.concatenate(self._parts)[: self._size]))
        return frames

    def flush(self) -> list[DenseFrame]:
        return []

    def _frame(self, counts: np.ndarray) -> DenseFrame:
        spec = self._spec
        samples = counts.astype(np.float32).reshape(-1, spec.order, self._per_chip)
        levels = samples.sum(axis=2) @ self._rows
        codes = (levels[: spec.bits] > 0).T @ (1 << np.arange(spec.bits)[::-1])
        return DenseFrame(self._t_start, DenseWords(codes))


@dataclass(frozen=True)
class DenseWords:
    """Signs of levels, as numbers: nothing is known to be silent or doubtful."""

    codes: Ints
    active: bool = True
    doubtful: bool = False


@dataclass(frozen=True)
class DenseFrame:
    """Has start and words of a TactileFrame."""

    t_start: float
    words: DenseWords


def main() -> None:
    report = Report("pareto", f"CPU time per frame against bit errors, 16 nodes, ρ = {RHO:.2f}")
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of the processes
    found: dict[str, list[Outcome]] = {}
    spawn = multiprocessing.get_context("spawn")
    with spawn.Pool(len(os.sched_getaffinity(0))) as pool:
        jobs = [(way, seed) for seed in range(STREAMS) for way in WAYS]
        streams = pool.starmap(stream, jobs, chunksize=1)
    with spawn.Pool(1) as pool:  # one by one
        for some, outcome in zip(streams, pool.map(measure, streams, chunksize=1), strict=True):
            found.setdefault(some.way.name, []).append(outcome)
    points = {name: Point.of(outcomes) for name, outcomes in found.items()}
    report.table(
        ["way", "µs", "bit error rate", "± 95 %", "wrong, not flagged", "lost frames"],
        [[name, *astuple(point)] for name, point in points.items()],
    )
    default = points[DEFAULT.name]
    report.finish(
        picture(points),
        rho=round(RHO, 3),
        bound=BOUND,
        default_us=default.cpu_us,
        default_ber=default.bit_error_rate,
    )


@dataclass(frozen=True)
class Point:
    """Holds what one way costs and errs; scatter: 95 % of the bit error rate.

    unflagged: share of words that are wrong without a flag. lost: share of frames.
    """

    cpu_us: float
    bit_error_rate: float
    scatter: float
    unflagged: float
    lost: float

    @classmethod
    def of(cls, outcomes: list[Outcome]) -> Point:
        words = sum(outcome.codes.size for outcome in outcomes)
        errors, bits = sum(outcome.bit_errors for outcome in outcomes), 10 * words
        return cls(
            1e6 * statistics.median(outcome.cpu_s for outcome in outcomes),
            errors / bits,
            1.96 * max(errors, 1) ** 0.5 / bits,
            sum(outcome.unflagged for outcome in outcomes) / words,
            sum(outcome.lost for outcome in outcomes) / sum(len(o.codes) for o in outcomes),
        )


def picture(points: dict[str, Point]) -> Figure:
    """Bit error rate against CPU time. Numbers beside the points are those of the legend."""
    figure = Figure(figsize=(10, 5))
    axes = figure.add_subplot()
    for number, (name, point) in enumerate(points.items()):
        colour = f"C{number % 10}"
        axes.errorbar(
            point.cpu_us,
            point.bit_error_rate,
            point.scatter,
            fmt="o^"[number // 10],
            color=colour,
            label=f"{number + 1}  {name}",
        )
        axes.annotate(
            f"{number + 1}",
            (point.cpu_us, point.bit_error_rate),
            (-5 - 4 * (number % 2), 5),
            color=colour,
            textcoords="offset points",
            ha="right",
            fontsize="small",
        )
    default = points[DEFAULT.name]
    axes.plot(default.cpu_us, default.bit_error_rate, "o", ms=18, mfc="none", color="k")
    axes.annotate(
        "default",
        (default.cpu_us, default.bit_error_rate),
        xytext=(0, -22),
        textcoords="offset points",
        ha="center",
    )
    axes.axhline(BOUND, color="k", ls="--", lw=1, label="matched filter, Q(ρ)")
    axes.set(xscale="log", yscale="log", xlabel="CPU time per frame, µs", ylabel="bit error rate")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


if __name__ == "__main__":
    main()
