# SPDX-License-Identifier: Apache-2.0

"""Bit errors against the matched-filter bound, and the paper's conditions in long streams.

Part one: all nodes send random words; the line starts at random, every frame is stretched by
0…11 %, and white noise sets ρ = √N·a/σ, so that no receiver makes fewer bit errors than Q(ρ).
Every frame is found anew, without knowledge of others. Bits of words taken for silence count as
wrong; so do those of frames that were not found, where these are more than one in a thousand.
`loss_db` says how many dB more ρ than the bound it takes to reach one bit error in a thousand, for
blind timing, at the worst of 16 and 256 nodes.

Part two: streams of frames as in the paper, of which every word must be right.
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.report import QUICK, Report
from benchmarks.style import sheet
from tactile_cdma.code.encode import line_chips, word_bits
from tactile_cdma.code.frame import MAX_STRETCH, FrameSpec
from tactile_cdma.framing.frame_reader import FrameReader
from tactile_cdma.framing.gaps.gap_timing import SIDE_CHIPS, GapTiming
from tactile_cdma.sim.channel import Channel, first_sample, point_samples
from tactile_cdma.words.words import Words
from test.support.single_frames import SingleReader

PAPER = FrameSpec(order=16, first_row=0, sign_seed=None, polarity=-1)
PAPER_SAMPLES, PAPER_NOISE_V = 8, (0.005, 0.010)
"""Samples per chip of its streams, and limits of their noise, V rms. Chosen."""
SPECS = {
    "16": FrameSpec(),
    "16, paper": PAPER,
    "256": FrameSpec(nodes=256, chip_s=3e-6),
    "256, row 0": FrameSpec(nodes=256, order=256, first_row=0, chip_s=3e-6),
}
TARGET = 1e-3
"""Bit error rate at which the loss is evaluated."""
TARGET_DB = 20 * math.log10(3.0902)
"""ρ at which Q(ρ) equals TARGET, dB."""


@dataclass(frozen=True)
class Condition:
    """Says how the line is sampled and timed.

    blind: GapTiming; else the frame's first sample is marked, and the nodes keep to the
        digitizer's clock: no stretch.
    rail: of amplifier and converter, in √n·A about the gap's level.
    """

    name: str
    blind: bool = True
    samples_per_chip: int = 8
    rail: float = 12.0
    adc_bits: int = 16


BLIND = Condition("blind")
CONDITIONS = (
    Condition("line", blind=False),
    BLIND,
    Condition("blind, 4 samples per chip", samples_per_chip=4),
    Condition("blind, clipped at 3·√n·A", rail=3.0),
    Condition("blind, 8 bits over ±4.5·√n·A", rail=4.5, adc_bits=8),
)


@dataclass(frozen=True)
class Job:
    """Some frames at one ρ: the work of a process at a time."""

    spec: str
    condition: Condition
    rho_db: float
    frames: int
    seed: int


class BitErrors(NamedTuple):
    """Counts frames sent and lost, and of those found bits and words, all and wrong ones."""

    frames: int
    lost: int
    bits: int
    bit_errors: int
    words: int
    word_errors: int

    @property
    def rate(self) -> float:
        """Bit error rate; too many lost frames are all errors."""
        share = self.lost / self.frames
        found = self.bit_errors / max(self.bits, 1)
        return found if share < TARGET else share + (1 - share) * found


class Streams(NamedTuple):
    """Counts frames with at least one word, and wrong words without a flag in them.

    lost, flagged: frames that were not found, and of which a word that was sent has a flag.
    """

    frames: int
    wrong: int
    lost: int
    flagged: int


def q(rho: float) -> float:
    """Return the matched-filter bound for one bit."""
    return 0.5 * math.erfc(rho / math.sqrt(2))


def run(job: Job) -> BitErrors:
    """Decode frames, each on its own line, and count errors."""
    spec, condition = SPECS[job.spec], job.condition
    rng = np.random.default_rng([job.seed, round(1000 * job.rho_db)])
    rate_hz = condition.samples_per_chip / spec.chip_s
    lost = bit_errors = word_errors = 0
    for _ in range(job.frames):
        codes, start_s, volts = lone_frame(spec, condition, job.rho_db, rng)
        if condition.blind:
            words = blind_words(volts, spec, rate_hz)
        else:
            words = marked_words(volts, spec, rate_hz, int(first_sample(start_s, rate_hz)))
        if words is None:
            lost += 1
            continue
        wrong = word_bits(words.codes ^ codes, spec.bits).sum(axis=1)
        wrong = np.where(words.active, wrong, spec.bits)
        bit_errors += int(wrong.sum())
        word_errors += int(np.count_nonzero(wrong))
    found = (job.frames - lost) * spec.nodes
    return BitErrors(job.frames, lost, found * spec.bits, bit_errors, found, word_errors)


def lone_frame(
    spec: FrameSpec, condition: Condition, rho_db: float, rng: np.random.Generator
) -> tuple[np.ndarray, float, np.ndarray]:
    """Make a frame of random words from all nodes, with a gap on either side.

    Returns codes (n,), the frame's start in s after the first sample, and volts (m,) float32.
    """
    rate_hz, swing_v = condition.samples_per_chip / spec.chip_s, spec.node_swing_v
    assert swing_v is not None
    channel = Channel(
        offset_v=0.2,
        stretch=MAX_STRETCH if condition.blind else 0.0,
        rail_v=condition.rail * math.sqrt(spec.nodes) * swing_v,
        adc_bits=condition.adc_bits,
    )
    gap_s = spec.frame_period_s - spec.frame_s * (1 + MAX_STRETCH)
    codes = rng.integers(0, 1 << spec.bits, spec.nodes)
    edges_s = gap_s * rng.uniform(1, 2) + channel.edges(spec, rng)
    chip = (edges_s[-1] - edges_s[0]) / spec.chips * rate_hz  # samples
    noise_v = swing_v * math.sqrt(spec.order * chip) / 10 ** (rho_db / 20)
    channel = replace(channel, noise_rms_v=noise_v)
    size = int((edges_s[-1] + gap_s * rng.uniform(1, 2)) * rate_hz)
    line_v = point_samples(line_chips(spec, codes).ravel(), edges_s, rate_hz, 0, size)
    return codes, edges_s[0], channel.volts(channel.digitize(line_v, spec, rng), spec)


def blind_words(volts: np.ndarray, spec: FrameSpec, rate_hz: float) -> Words | None:
    """Return words of the only frame in a line; None if there is not exactly one."""
    timing = blind_timing(spec, rate_hz)
    frames = timing.feed(0, volts) + timing.flush()
    heard = [frame.words for frame in frames if frame.words is not None]
    return heard[0] if len(heard) == 1 else None


def blind_timing(spec: FrameSpec, rate_hz: float) -> GapTiming:
    """Find frames of a digitizer whose rails are not known."""
    return GapTiming(FrameReader(spec, rate_hz, side_chips=SIDE_CHIPS), rate_hz)


def marked_words(volts: np.ndarray, spec: FrameSpec, rate_hz: float, first: int) -> Words | None:
    """Return words of the frame of which the first sample is known; before it is silence."""
    reader, silence = SingleReader(spec, rate_hz), volts[:first].astype(np.float64)
    reader.learn_rest(float(silence.mean()), float(silence.var()) / reader.chip)
    frame = reader.read(volts[first:])
    return None if frame is None else frame.words


def paper_stream(seed: int, frames: int = 100, samples_per_chip: int = PAPER_SAMPLES) -> Streams:
    """Try the paper's skin: 16 nodes, any number of which speak; edges jitter by 0.1 chip."""
    rng, spec = np.random.default_rng([seed, 16]), PAPER
    rate_hz = samples_per_chip / spec.chip_s
    channel = Channel(
        offset_v=rng.uniform(-0.5, 0.5),
        noise_rms_v=rng.uniform(*PAPER_NOISE_V),
        stretch=0.10,
        jitter=0.10,
        adc_bits=12,
    )
    # The recording begins anywhere; a frame that is cut does not count.
    begin_s = rng.uniform(0, spec.frame_period_s)
    sent, pieces, first = [], [], 0
    for number in range(frames):
        start_s = begin_s + number * spec.frame_period_s
        stop = int(first_sample(start_s + spec.frame_period_s, rate_hz))
        active = rng.permutation(spec.nodes) < rng.integers(0, spec.nodes + 1)
        codes = rng.integers(0, 1 << spec.bits, spec.nodes)
        levels = line_chips(spec, codes, active).ravel()
        edges_s = start_s + channel.edges(spec, rng)
        pieces.append(point_samples(levels, edges_s, rate_hz, first, stop))
        sent.append((codes, active))
        first = stop
    cut = int(rng.uniform(0, spec.frame_period_s) * rate_hz)
    volts = channel.volts(channel.digitize(np.concatenate(pieces), spec, rng), spec)[cut:]
    whole = [begin_s + i * spec.frame_period_s > (cut + 16) / rate_hz for i in range(frames)]
    timing, wrong, found, right = blind_timing(spec, rate_hz), 0, set[int](), set[int]()
    for at in range(0, volts.size, 1000):
        for frame in timing.feed(at, volts[at : at + 1000]):
            words = frame.words
            if words is None:
                continue
            start_s = (frame.start + 0.5 + cut) / rate_hz
            number = round((start_s - begin_s) / spec.frame_period_s)
            found.add(number)
            codes, active = sent[number]
            sure = words.active & ~words.doubtful
            wrong += int(np.count_nonzero(sure & ((words.codes != codes) | ~active)))
            if np.array_equal(sure, active):
                right.add(number)
    asked = {i for i, (_, active) in enumerate(sent) if whole[i] and active.any()}
    return Streams(len(asked), wrong, len(asked - found), len(asked & found - right))


def jobs() -> Iterator[Job]:
    """Jobs of part one, with enough frames for the errors wanted: most near TARGET."""
    grid = (8.5, 9.4, 10.1) if QUICK else (7.0, 8.0, 9.0, 9.6, 10.1, 11.0)
    errors = 380 if QUICK else 1600
    for name, spec in SPECS.items():
        frame_bits = spec.bits * spec.nodes
        for condition in CONDITIONS if spec.first_row or not QUICK else (BLIND,):
            for rho_db in grid if condition is BLIND else [at for at in grid if at > 9]:
                near = condition is BLIND and 9.2 < rho_db < 10.2
                wanted = errors if near else errors / (10 if QUICK else 4)
                rate = max(q(10 ** (rho_db / 20)), TARGET / 2)
                frames = math.ceil(wanted / (rate * frame_bits))
                parts = math.ceil(frames * frame_bits / 50_000)
                for part in range(parts):
                    yield Job(name, condition, rho_db, math.ceil(frames / parts), part)


def loss_db(points: list[tuple[float, float]]) -> float:
    """Additional ρ over the bound to reach the target, dB.

    points: (ρ in dB, measured bit error rate), rising in ρ. Interpolated in log(rate); NaN where
    the points do not bracket the target.
    """
    for (left, high), (right, low) in pairwise(points):
        if high >= TARGET > low > 0:
            share = math.log(high / TARGET) / math.log(high / low)
            return left + share * (right - left) - TARGET_DB
    return math.nan


def main() -> None:
    report = Report("error", "Bit errors against the matched-filter bound; the paper's streams")
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of the processes
    streams = 110 if QUICK else 1100
    todo = list(jobs())
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        paper = pool.imap_unordered(paper_stream, range(streams), chunksize=4)
        tallies = pool.map(run, todo, chunksize=1)
        streams_of_paper = Streams(*map(sum, zip(*paper, strict=True)))
    sums: dict[tuple[str, Condition, float], BitErrors] = {}
    for job, tally in zip(todo, tallies, strict=True):
        key = (job.spec, job.condition, job.rho_db)
        sums[key] = BitErrors(
            *map(sum, zip(sums.get(key, BitErrors(0, 0, 0, 0, 0, 0)), tally, strict=True))
        )
    report.table(
        ["nodes", "condition", "ρ dB", "frames", "lost", "bit errors", "rate", "± 95 %", "Q(ρ)",
         "word error rate", "1−(1−Q)^k"],
        [row(*key, tally) for key, tally in sums.items()],
        keep=False,
    )  # fmt: skip
    losses = {
        (name, condition): loss_db(
            [(at, tally.rate) for (n, c, at), tally in sums.items() if (n, c) == (name, condition)]
        )
        for name in SPECS
        for condition in CONDITIONS
    }
    report.table(
        ["nodes", *(f"{condition.name}, dB" for condition in CONDITIONS)],
        [[name, *(losses[name, condition] for condition in CONDITIONS)] for name in SPECS],
    )
    report.finish(
        picture(sums),
        loss_db=round(float(np.max([losses[name, BLIND] for name in SPECS])), 3),
        **{f"paper_{name}": value for name, value in streams_of_paper._asdict().items()},
    )


def row(name: str, condition: Condition, rho_db: float, tally: BitErrors) -> list[object]:
    """Return a row of the table: measured rates beside the theory."""
    bound = q(10 ** (rho_db / 20))
    scatter = 1.96 * math.sqrt(max(tally.bit_errors, 1)) / max(tally.bits, 1)
    word_bound = 1 - (1 - bound) ** SPECS[name].bits
    words = tally.word_errors / max(tally.words, 1)
    counts = [tally.frames, tally.lost, tally.bit_errors]
    return [name, condition.name, rho_db, *counts, tally.rate, scatter, bound, words, word_bound]


def picture(sums: dict[tuple[str, Condition, float], BitErrors]) -> Figure:
    """Bit error rate against ρ, with the bound; one panel per specification."""
    figure = sheet(660)
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    for panel, name in zip(panels.flat, SPECS, strict=True):
        at = np.linspace(7, 12, 100)
        panel.semilogy(at, [q(10 ** (db / 20)) for db in at], "k", label="bound Q(ρ)")
        for marker, condition in zip("x.+^v", CONDITIONS, strict=True):
            points = [
                (db, tally.rate)
                for (n, c, db), tally in sums.items()
                if (n, c) == (name, condition) and tally.bit_errors
            ]
            panel.semilogy(
                [db for db, _ in points], [rate for _, rate in points], marker, label=condition.name
            )
        spec = SPECS[name]
        panel.set_title(f"{spec.nodes} nodes, order {spec.order}, from row {spec.first_row}")
    panels[0, 0].legend(loc="lower left", fontsize="small")
    for panel in panels[1]:
        panel.set_xlabel("ρ, dB")
    for panel in panels[:, 0]:
        panel.set_ylabel("bit error rate")
    return figure


if __name__ == "__main__":
    main()
