# SPDX-License-Identifier: Apache-2.0

"""Words that are wrong, invented or missed without a flag, on lines of an independent generator.

    make bench-doubt       QUICK=1: fewer frames; ONLY=hum: conditions with this in their name, with
                           the first words that were not flagged

The signals of `independent_line` pass through the driver's whole decoding chain, from the
digitizer's packets to words. Every frame that was sent is compared with the decoded frame nearest
in time, word by word:

- right, flagged: the word that was sent, without and with a flag.
- missed: a node transmitted and its frame is published with the node silent, without a flag.
- wrong ⚑, wrong: another word, or one where none was, with a flag; another word without one.
- invented: a word of a node that did not transmit, without a flag.
- lost: the frame was rejected or not found, which claims nothing.

A flag is what the driver publishes: a doubtful word, or a node that counts as doubled or faulty.
`unflagged` sums up missed, wrong and invented. rail_silent: words of frames that are published as
silent although more than half of the samples were at a rail. phantom: words of nodes that never
transmitted in that recording, flagged or not. Where nothing but the waveform is known, and another
start with other words gives exactly the same waveform, flags are right; such frames do not count in
right_flagged_share.
"""

from __future__ import annotations

import multiprocessing
import os
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.wire._protocol import MAX_SAMPLES, SyncMode
from tactile_cdma.wire.messages import FrameLayout, Info, Samples
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words.decode import Words

from .independent_line import (
    SILENT,
    Digitizer,
    Line,
    Recording,
    Skin,
    Talk,
    Truth,
    code_book,
    render,
)
from .report import QUICK, Report

Bools = NDArray[np.bool_]

ONLY = os.environ.get("ONLY", "")
FRAMES = 100 if QUICK else 250
"""Frames of one recording: enough for a decoder to learn the line, and then be surprised."""
RECORDINGS = 1 if QUICK else 8
AT_RAIL = 0.5
"""Share of a frame's samples at a rail beyond which nobody can tell who was silent."""
LEARNING = 30
"""Frames until a decoder may know the raster of frame starts."""
MOST_SHIFT = 4
"""Chips by which another frame may be shifted to tie with the true one."""
SHOWN = 5
"""Unflagged words of a condition that are listed with ONLY."""

RAW = Digitizer()
MEANS = Digitizer(integrated=True, samples_per_chip=8)
BLIND = Digitizer(marked=False)
ORDERS = {
    12: Skin(nodes=11, order=12, period_chips=160),
    16: Skin(nodes=15, order=16, period_chips=208),
    20: Skin(),
}
LARGE = Skin(nodes=64, order=68, period_chips=880, amplitude_v=0.15)
PAPER = Skin(order=16, first_row=0, sign_seed=None, polarity=-1)
TWO = Talk(together=2)
TWO_EQUAL = Talk(together=2, words="equal")
CHURN = Talk(share=0.3, stay=8, words="slow")


@dataclass(frozen=True)
class Condition:
    """A line and what the decoder is told about it.

    more: times the usual number of recordings. learnt: the amplitude is not in the configuration.
    """

    name: str
    digitizer: Digitizer
    line: Line = Line()  # noqa: RUF009  (frozen)
    talk: Talk = Talk()  # noqa: RUF009
    skin: Skin = Skin()  # noqa: RUF009
    more: int = 1
    learnt: bool = False


def conditions() -> Iterator[Condition]:
    """All conditions; names begin with how frames are timed."""
    for name, digitizer in (("marks", RAW), ("means", MEANS), ("gap", BLIND)):
        yield Condition(f"{name}: clean", digitizer)
        yield Condition(f"{name}: clean, 64 nodes", digitizer, skin=LARGE)
        yield Condition(f"{name}: joining and leaving", digitizer, talk=CHURN)
        for ratio in (1.05, 1.3):
            line = Line(offset_v=ratio * digitizer.rail_v)
            yield Condition(f"{name}: offset {ratio} x rail", digitizer, line)
        yield Condition(f"{name}: low-pass 0.3 chip, 1 node", digitizer,
                        Line(low_pass_chips=0.3), Talk(speakers=1))  # fmt: skip
        yield Condition(f"{name}: hum of A/3", digitizer, Line(hum_v=0.1))
        yield Condition(f"{name}: 1000 impulses/s of 1 V", digitizer, Line(impulses_hz=1000))
    for order, skin in ORDERS.items():
        for words, talk in (("random", TWO), ("equal", TWO_EQUAL)):
            for jitter in (1.0, 3.0):
                line = Line(start_jitter_chips=jitter)
                name = f"gap: order {order}, 2 nodes, {words} words, jitter {jitter:g} chips"
                yield Condition(name, BLIND, line, talk, skin)
            name = f"gap: order {order}, 2 nodes, {words} words, slips"
            yield Condition(name, BLIND, Line(slip_share=0.03), talk, skin)
    yield Condition("gap: stretch 10 %", BLIND, Line(stretch=0.1))
    yield Condition("gap: high-pass 500 Hz, 2 nodes", BLIND, Line(high_pass_hz=500), TWO)
    yield Condition(
        "gap: a node 0.6 chip late", BLIND, Line(late=((2, 0.6),)), Talk(speakers=(2, 9))
    )


class Decoded(NamedTuple):
    """A frame as published: its start, chips, its words, and which nodes count as broken."""

    start_chips: float
    words: Words
    invalid: Bools


class Tally(NamedTuple):
    """Counts of words; see the module's docstring. tied: right words in frames that tie."""

    words: int = 0
    right: int = 0
    flagged: int = 0
    missed: int = 0
    wrong_flagged: int = 0
    wrong: int = 0
    invented: int = 0
    lost: int = 0
    rail_silent: int = 0
    phantom: int = 0
    tied: int = 0

    @property
    def unflagged(self) -> int:
        return self.missed + self.wrong + self.invented

    @property
    def flagged_share(self) -> float:
        return self.flagged / max(self.right + self.flagged, 1)


class Job(NamedTuple):
    """One recording of a condition."""

    condition: Condition
    seed: int


def total(tallies: list[Tally]) -> Tally:
    return Tally(*map(sum, zip(*tallies, strict=True)))


def run(job: Job) -> tuple[Tally, list[str]]:
    """Render a recording, decode it and compare; also the first unflagged words."""
    condition = job.condition
    seed = [zlib.crc32(condition.name.encode()), job.seed]
    recording = render(
        condition.skin, condition.talk, condition.line, condition.digitizer, FRAMES, seed
    )
    return compare(recording, decode(recording, condition.learnt), condition.line)


def decode(recording: Recording, learnt: bool = False) -> list[Decoded]:
    """What the driver makes of a recording."""
    skin, digitizer = recording.skin, recording.digitizer
    config, info = _config(recording, learnt), _info(recording, learnt)
    pipeline, writer = Pipeline(config, background=False), PacketWriter()
    pipeline.feed(writer.encode(info), 0.0)
    if pipeline.problem:
        raise ValueError(pipeline.problem)
    per_chip = 1 if digitizer.integrated else digitizer.samples_per_chip
    heard = []
    for stretch in recording.runs:
        for begin in range(0, stretch.counts.size, MAX_SAMPLES):
            t_chips = stretch.t_chips + begin / per_chip
            packet = Samples(
                round(1e6 * skin.chip_s * t_chips),
                stretch.first_index + begin,
                stretch.counts[begin : begin + MAX_SAMPLES],
                sync=stretch.marked and not begin,
            )
            for frame in pipeline.feed(writer.encode(packet), t_chips * skin.chip_s):
                heard.append((frame, pipeline.health.invalid.copy()))
    heard += [(frame, pipeline.health.invalid) for frame in pipeline.flush()]
    return [Decoded(frame.t_start / skin.chip_s, frame.words, bad) for frame, bad in heard]


def _config(recording: Recording, learnt: bool) -> SkinConfig:
    skin, digitizer = recording.skin, recording.digitizer
    return SkinConfig.of(
        {
            "nodes": skin.nodes,
            "bits": skin.bits,
            "parity": skin.parity,
            "order": skin.order,
            "first_row": skin.first_row,
            "sign_seed": -1 if skin.sign_seed is None else skin.sign_seed,
            "chip_us": 1e6 * skin.chip_s,
            "frame_period_ms": 1e3 * skin.chip_s * skin.period_chips,
            "drive": skin.drive,
            "polarity": skin.polarity,
            "amplitude_mv": 0.0 if learnt else 1e3 * skin.amplitude_v,
            "timing": "line" if digitizer.marked else "gap",
            "samples_per_chip": 1 if digitizer.integrated else digitizer.samples_per_chip,
        }
    )


def _info(recording: Recording, learnt: bool) -> Info:
    digitizer, config = recording.digitizer, _config(recording, learnt)
    top = 2 ** (digitizer.adc_bits - 1)
    return Info(
        frame=FrameLayout.of(config.spec, config.samples_per_chip),
        sample_rate_uhz=round(1e6 * config.samples_per_chip / config.spec.chip_s),
        volts_per_count=digitizer.volts_per_count,
        min_count=-top,
        max_count=top - 1,
        sync_mode=SyncMode.DRIVE if digitizer.marked else SyncMode.NONE,
        integrated=digitizer.integrated,
    )


def compare(recording: Recording, decoded: list[Decoded], line: Line) -> tuple[Tally, list[str]]:
    """Count the words; also describe the first unflagged ones."""
    truths, never = recording.frames, recording.never
    starts = np.array([truth.start_chips for truth in truths])
    nearest = [int(np.argmin(np.abs(starts - frame.start_chips))) for frame in decoded]
    heard: dict[int, Decoded] = {}
    extra: list[Decoded] = []
    for number, frame in zip(nearest, decoded, strict=True):
        near = abs(starts[number] - frame.start_chips) < recording.skin.period_chips / 2
        other = heard.get(number)
        if not near:
            extra.append(frame)
        elif other is None or (_off(frame, truths[number]) < _off(other, truths[number])):
            extra += [other] if other else []
            heard[number] = frame
        else:
            extra.append(frame)
    moves = not recording.digitizer.marked and bool(line.start_jitter_chips or line.slip_share)
    tallies, complaints = [], []
    for number, truth in enumerate(truths):
        blind = not recording.digitizer.marked and (moves or number < LEARNING)
        tally = _count(truth, heard.get(number), blind and ties(recording.skin, truth.codes))
        tallies.append(tally)
        if tally.unflagged:
            complaints.append(_complaint(number, truth, heard[number]))
    for frame in extra:
        flagged = _flags(frame)
        invented = int(np.count_nonzero(frame.words.active & ~flagged))
        rest = int(np.count_nonzero(frame.words.active & flagged))
        tallies.append(Tally(invented=invented, wrong_flagged=rest))
        if invented:
            complaints.append(f"  no frame began near chip {frame.start_chips:.1f}")
    phantom = sum(int(np.count_nonzero(frame.words.active & never)) for frame in decoded)
    rail_silent = sum(
        int(np.count_nonzero(~frame.words.active & ~_flags(frame)))
        for number, frame in zip(nearest, decoded, strict=True)
        if truths[number].clipped > AT_RAIL
    )
    return total(tallies)._replace(phantom=phantom, rail_silent=rail_silent), complaints


def _off(frame: Decoded, truth: Truth) -> tuple[bool, float]:
    """How badly a decoded frame fits a true one: silent ones last, then by the start."""
    spoke = bool((truth.codes != SILENT).any())
    return bool(frame.words.active.any()) != spoke, abs(frame.start_chips - truth.start_chips)


def _flags(frame: Decoded) -> Bools:
    """What is published as doubtful or broken, (n,)."""
    flags: Bools = frame.words.doubtful | frame.invalid
    return flags


def _count(truth: Truth, frame: Decoded | None, tie: bool) -> Tally:
    """The words of one frame."""
    spoke = truth.codes != SILENT
    words = int(np.count_nonzero(spoke))
    if frame is None:
        return Tally(words=words, lost=words)
    flag, active = _flags(frame), frame.words.active
    same = spoke & active & (frame.words.codes == truth.codes)
    other = (spoke | active) & ~same
    count: dict[str, Any] = {
        "right": same & ~flag,
        "tied" if tie else "flagged": same & flag,
        "missed": other & ~active & ~flag,
        "wrong_flagged": other & flag,
        "wrong": other & active & spoke & ~flag,
        "invented": other & ~spoke & ~flag,
    }
    return Tally(words, **{name: int(np.count_nonzero(some)) for name, some in count.items()})


def _complaint(number: int, truth: Truth, frame: Decoded) -> str:
    """One frame's unflagged words."""
    active, codes = frame.words.active, frame.words.codes
    told = np.where(active, codes, SILENT)
    wrong = np.flatnonzero((told != truth.codes) & ~_flags(frame))
    words = ", ".join(f"node {i} sent {truth.codes[i]} told {told[i]}" for i in wrong[:4])
    late = frame.start_chips - truth.start_chips
    return (
        f"  frame {number}, {late:+.2f} chips off, {np.sum(truth.codes != SILENT)} active, "
        f"{len(wrong)} unflagged: {words}"
    )


def ties(skin: Skin, codes: NDArray[np.integer[Any]]) -> bool:
    """Whether another start, whole chips away, and other words give exactly the same waveform."""
    chips = skin.waveforms(codes).sum(axis=0) / skin.amplitude_v
    book = code_book(skin.order)[skin.first_row : skin.first_row + skin.nodes].astype(float)
    for shift in (*range(-MOST_SHIFT, 0), *range(1, MOST_SHIFT + 1)):
        cut = chips[:shift] if shift > 0 else chips[shift:]
        if not chips.any() or cut.any():
            continue
        # What a frame that begins `shift` chips later finds in its own chips.
        moved = np.roll(chips, -shift).reshape(-1, skin.order)
        levels = moved @ book.T / skin.order
        spoke = np.abs(levels).mean(axis=0) > 0.5
        if np.allclose(np.sign(levels) * spoke @ book, moved):
            return True
    return False


def main() -> None:
    report = Report("doubt", "Words not flagged, on an independent line", QUICK or bool(ONLY))
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of the processes
    chosen = [condition for condition in conditions() if ONLY in condition.name]
    jobs = [Job(c, seed) for c in chosen for seed in range(RECORDINGS * c.more)]
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        results = pool.map(run, jobs, chunksize=1)
    tallies = {
        condition.name: total(
            [tally for job, (tally, _) in zip(jobs, results, strict=True) if job[0] == condition]
        )
        for condition in chosen
    }
    report.table(
        ["condition", "words", "right", "flagged", "missed", "wrong ⚑", "wrong", "invented",
         "lost", "rail silent", "phantom", "tied"],
        [[name, *tally] for name, tally in tallies.items()],
    )  # fmt: skip
    if ONLY:
        for job, (_, complaints) in zip(jobs, results, strict=True):
            for complaint in complaints[:SHOWN]:
                print(f"{job.condition.name}, recording {job.seed}:{complaint}")
    everything = total(list(tallies.values()))
    report.finish(
        picture(tallies),
        words=everything.words,
        unflagged=everything.unflagged,
        rail_silent=everything.rail_silent,
        phantom=everything.phantom,
        right_flagged_share=round(everything.flagged_share, 4),
    )


def picture(tallies: dict[str, Tally]) -> Figure:
    """Shares of the words of each condition."""
    figure = Figure(figsize=(9, 0.22 * len(tallies) + 1))
    axes = figure.subplots()
    left = np.zeros(len(tallies))
    kinds = {
        "right": "tab:green",
        "flagged": "gold",
        "tied": "khaki",
        "wrong_flagged": "tab:orange",
        "lost": "lightgrey",
        "unflagged": "tab:red",
    }
    sums = np.array([sum(getattr(t, kind) for kind in kinds) or 1 for t in tallies.values()])
    for kind, colour in kinds.items():
        share = np.array([getattr(tally, kind) for tally in tallies.values()]) / sums
        axes.barh(list(tallies), share, left=left, color=colour, label=kind.replace("_", " "))
        left += share
    axes.invert_yaxis()
    axes.tick_params(axis="y", labelsize=7)
    axes.set_xlabel("share of the words")
    axes.legend(ncols=len(kinds), fontsize=7, loc="lower center", bbox_to_anchor=(0.4, 1.0))
    return figure


if __name__ == "__main__":
    main()
