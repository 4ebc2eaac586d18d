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

Then what a frame costs that is certain, and one in doubt, of skins whose nodes all speak (COSTS).
"""

from __future__ import annotations

import multiprocessing
import os
import re
import statistics
import time
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks import style
from benchmarks.line_packets import config_of, introduction, packets
from benchmarks.report import QUICK, ROOT, Report, rows_of
from tactile_cdma.config.parameters import Value, read_file
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
    default_order,
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


# What doubt costs


@dataclass(frozen=True)
class Cost:
    """A skin whose frames are timed, with its parameters.

    frames: that are rendered, of which the first `warm_up` are not measured. stretch: of frames
        that the waveform alone shows, up to this share; else others put frames in doubt.
    """

    name: str
    skin: Skin
    values: Mapping[str, Value]
    frames: int
    warm_up: int
    stretch: float = 0.0

    def lines(self) -> dict[str, Line]:
        """The lines that are measured: a sound one, and those beside it."""
        amplitude_v, order = self.skin.amplitude_v, self.skin.order
        if self.stretch:
            return {SURE: Line(stretch=self.stretch), STEADY: Line()}
        return {
            SURE: Line(),
            f"ρ {DOUBT_RHO:g}": Line(noise_v=amplitude_v * order**0.5 / DOUBT_RHO),
            "hum of 2 A": Line(hum_v=2 * amplitude_v),
            "a node 0.6 chip late": Line(late=((2, 0.6),)),
        }


SURE, STEADY = "sound", "chips of one duration"
DOUBT_RHO = 3.0
"""√N·a/σ at which every frame is in doubt, and hardly any is missed."""
COST_ROUNDS = 7 if QUICK else 25
FAST = {
    name: value
    for name, value in read_file(ROOT / "config" / "thousand_skin.yaml").items()
    if name in ("nodes", "order", "chip_us", "frame_period_ms", "samples_per_chip", "scramble")
}
COSTS = (
    Cost("16", Skin(), {}, 60, 20),
    Cost(
        "256",
        Skin(256, default_order(257), chip_s=6.25e-6, period_chips=3400),
        {"nodes": 256, "chip_us": 6.25, "frame_period_ms": 21.25},
        *((16, 6) if QUICK else (40, 10)),
    ),
    # Without the restarts of config/thousand_skin.yaml, which the independent line does not have.
    Cost(
        "900",
        Skin(900, 912, chip_s=2e-6, period_chips=9980, scramble=True),
        FAST,
        *((6, 2) if QUICK else (20, 5)),
    ),
    Cost(
        "paper",
        Skin(16, 16, first_row=0, sign_seed=None, polarity=-1),
        {
            name: value
            for name, value in read_file(ROOT / "config" / "paper_skin.yaml").items()
            if name not in ("rows", "columns")
        },
        100,
        WARM_UP,
        stretch=0.1,
    ),
)
"""Skins of which `us_sure_`, `us_doubt_` and `us_paper` are; by gaps only the paper's."""


@dataclass(frozen=True)
class Chunks:
    """What a digitizer sends, a frame's period at a time: host time, s, and bytes.

    warm_up: of them, that are not measured.
    """

    config: SkinConfig
    chunks: list[tuple[float, bytes]]
    warm_up: int

    def play(self) -> tuple[list[float], int, int]:
        """CPU time of each period, s; and how many frames were measured, certain and in doubt."""
        pipeline, spent_s, sure, doubtful = Pipeline(self.config), list[float](), 0, 0
        for number, (t_host, data) in enumerate(self.chunks):
            begin_s = time.thread_time()
            frames = pipeline.feed(data, t_host)
            took_s = time.thread_time() - begin_s
            if number < self.warm_up:
                continue
            spent_s.append(took_s)
            holds = [frame.certificate.holds for frame in frames if frame.certificate is not None]
            sure, doubtful = sure + sum(holds), doubtful + len(holds) - sum(holds)
        return spent_s, sure, doubtful


def chunked(cost: Cost, line: Line) -> Chunks:
    """Render a stream of such a skin."""
    skin, config = cost.skin, SkinConfig.of(dict(cost.values))
    digitizer = Digitizer(
        integrated=config.samples_per_chip == 1,
        marked=config.timing == "line",
        rail_v=RAIL_V * (skin.nodes / 16) ** 0.5,
        adc_bits=16,
    )
    writer, recording = PacketWriter(), render(skin, Talk(), line, digitizer, cost.frames, [3])
    chunks = [(0.0, writer.encode(introduction(config, digitizer)))]
    begins = [frame.start_chips - 1 for frame in recording.frames]
    for t_chips, t_host, data in packets(recording, writer):
        if len(chunks) <= len(begins) and t_chips >= begins[len(chunks) - 1]:
            chunks.append((t_host, b""))
        chunks[-1] = t_host, chunks[-1][1] + data
    return Chunks(config, chunks, cost.warm_up)


def timed(streams: dict[str, Chunks]) -> dict[str, tuple[float, float]]:
    """Median CPU time per frame, s, of streams by turns; and the share of frames in doubt."""
    spent_s: dict[str, list[float]] = {name: [] for name in streams}
    shares: dict[str, float] = {}
    for number in range(1 + COST_ROUNDS):
        for name, stream in streams.items():
            times_s, sure, doubtful = stream.play()
            shares[name] = doubtful / max(1, sure + doubtful)
            spent_s[name] += times_s if number else []  # the first round warms up
    return {name: (statistics.median(spent_s[name]), shares[name]) for name in streams}


def costs(report: Report, rendered: dict[tuple[str, str], Chunks]) -> dict[str, float]:
    """Table of what frames cost by skin and line; the figures of the last line."""
    rows, figures = [], dict[str, float]()
    for cost in COSTS:
        streams = {line: rendered[cost.name, line] for line in cost.lines()}
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            found = pool.apply(timed, (streams,))
        rows += [[cost.name, line, 1e6 * took_s, share] for line, (took_s, share) in found.items()]
        sure_us = 1e6 * found.pop(SURE)[0]
        if cost.stretch:
            figures[f"us_{cost.name}"] = sure_us
            figures[f"us_{cost.name}_steady"] = 1e6 * found[STEADY][0]
        else:
            doubt_s = statistics.median(took_s for took_s, _ in found.values())
            figures |= {f"us_sure_{cost.name}": sure_us, f"us_doubt_{cost.name}": 1e6 * doubt_s}
    report.table(["skin", "line", "µs/frame", "in doubt"], rows)
    return figures


def main() -> None:
    report = Report("pareto", f"CPU time per frame against bit errors, 16 nodes, ρ = {RHO:.2f}")
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of the processes
    lines = [(cost, name, line) for cost in COSTS for name, line in cost.lines().items()]
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        jobs = [(way, seed) for seed in range(STREAMS) for way in WAYS]
        streams = pool.starmap(stream, jobs, chunksize=1)
        chunks = pool.starmap(chunked, [(cost, line) for cost, _, line in lines], chunksize=1)
    found: dict[str, list[Outcome]] = {}
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        for some, outcome in zip(streams, pool.map(measure, streams, chunksize=1), strict=True):
            found.setdefault(some.way.name, []).append(outcome)
    points = {name: Point.of(outcomes) for name, outcomes in found.items()}
    report.table(
        ["way", "µs", "bit error rate", "± 95 %", "wrong, not flagged", "lost frames"],
        [[name, *astuple(point)] for name, point in points.items()],
    )
    rendered = {(cost.name, name): one for (cost, name, _), one in zip(lines, chunks, strict=True)}
    default = points[DEFAULT.name]
    report.finish(
        picture(report.tables),
        rho=round(RHO, 3),
        bound=BOUND,
        default_us=default.cpu_us,
        default_ber=default.bit_error_rate,
        **costs(report, rendered),
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


def picture(tables: list[list[list[Any]]]) -> Figure:
    """Draw time and bit error rate of each way, a line for each."""
    rows = rows_of(tables, "way")
    at, names = np.arange(len(rows)), [str(row[0]) for row in rows]
    us, errors, scatter = np.array([row[1:4] for row in rows]).T
    figure = style.sheet(560)
    times, rates = figure.subplots(1, 2, sharey=True, width_ratios=(1, 1.3))
    kinds = {"gap": style.ORANGE, "late": style.PINK, "dense": style.GREY}
    colours = [kinds.get(re.split(r"\W", name)[0], style.BLUE) for name in names]
    times.barh(at, us, color=colours)
    rates.axvline(BOUND, color=style.BLACK, ls="--", lw=1)
    rates.annotate("matched filter", (1.08 * BOUND, -0.75), annotation_clip=False)
    for y, error, width, colour in zip(at, errors, scatter, colours, strict=True):
        rates.errorbar(error, y, xerr=width, fmt="o", color=colour)
    times.set_yticks(at, [name + (" (default)" if name == DEFAULT.name else "") for name in names])
    times.set(xscale="log", xlabel="CPU time per frame, µs", xlim=(5, 4000))
    rates.set(xscale="log", xlabel="bit error rate, 95 %", ylim=(len(rows) - 0.4, -0.9))
    return figure


if __name__ == "__main__":
    main()
