# SPDX-License-Identifier: Apache-2.0

"""Words that are wrong, invented or missed without a flag, on lines of an independent generator.

    make bench-doubt       QUICK=1: fewer frames; ONLY=hum: conditions with this in their name, with
                           the first words that were not flagged

The signals of `independent_line` pass through the driver's whole decoding chain, from the
digitizer's packets to words. Every frame that was sent is compared with the decoded frame nearest
in time, word by word:

- right, right but flagged: the word that was sent, without and with a flag. tied: the same with a
  flag, in a frame that is given by nothing but the waveform, where another start with other words
  gives exactly the same waveform: there a flag is due.
- silent, silent but flagged: nodes that did not transmit and are published as silent, all of them
  and those with a flag that is not due to such a tie.
- missed: a node transmitted, and its frame is published with the node silent, without a flag.
- wrong flagged: another word, or one where none was, with a flag.
- wrong not flagged, invented not flagged: the same without one; of a node that transmitted, and of
  one that did not.
- lost: the frame was rejected or not found, which claims nothing.
- rail silent: words published as silent, without a flag, although more than half of the frame's
  samples were at a rail.
- phantom: words, without a flag, of nodes that never transmitted in that recording.

A flag is what the driver publishes: a doubtful word, or a node that counts as doubled or faulty.
Words are those sent. `unflagged` sums up missed, wrong and invented without a flag, on all lines;
the shares of right words and of silences that are flagged leave out the rough ones
(`Condition.rough`), on which flags are due.
"""

from __future__ import annotations

import multiprocessing
import os
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words.decode import Words
from test.support.independent_line import (
    SILENT,
    Digitizer,
    Ints,
    Line,
    Recording,
    Skin,
    Talk,
    Truth,
    code_book,
    render,
    row_sign,
)

from .line_packets import introduction, packets
from .report import QUICK, Report

Bools: TypeAlias = NDArray[np.bool_]

ONLY = os.environ.get("ONLY", "")
FRAMES = 60 if QUICK else 250
"""Frames of one recording: enough for a decoder to learn the line, and then be surprised."""
RECORDINGS = 1 if QUICK else 4
AT_RAIL = 0.5
"""Share of a frame's samples at a rail beyond which nobody can tell who was silent."""
LEARNING = 30
"""Frames until a decoder may know the raster of frame starts."""
MOST_SHIFT = 4
"""Chips by which another frame may be shifted to tie with the true one."""
ALL_RIGHT = 0.99
"""Share of right words beyond which a condition is left out of the picture."""
SHOWN = 5
"""Unflagged words of a condition that are listed with ONLY."""

RAW = Digitizer()
MEANS = Digitizer(integrated=True, samples_per_chip=8)
BLIND = Digitizer(marked=False)
TIMINGS = {"marks": RAW, "means": MEANS, "gap": BLIND}
ORDERS = {
    12: Skin(nodes=11, order=12, period_chips=160),
    16: Skin(nodes=15, order=16, period_chips=208),
    20: Skin(),
}
PAPER = Skin(order=16, first_row=0, sign_seed=None, polarity=-1, period_chips=208)
LARGE = Skin(nodes=64, order=68, period_chips=880, amplitude_v=0.15)
ONE, TWO = Talk(together=1), Talk(together=2)
ALONE = Talk(speakers=1)
TWO_EQUAL = Talk(together=2, words="equal")
CHURN = Talk(share=0.3, stay=8, words="slow")
FEW = Talk(speakers=(0, 2, 3, 5), share=0.6, stay=8)
"""Joining and leaving: all nodes, and few, among them the one that some conditions impair."""


@dataclass(frozen=True)
class Condition:
    """A line and what the decoder is told about it.

    learnt: the amplitude is not in the configuration. rough: so disturbed that right words may be
    flagged, and lost.
    """

    name: str
    line: Line = Line()  # noqa: RUF009  (frozen)
    talk: Talk = Talk()  # noqa: RUF009
    skin: Skin = Skin()  # noqa: RUF009
    digitizer: Digitizer = RAW
    learnt: bool = False
    rough: bool = False


SKINS = (
    Condition("clean"),
    Condition("clean, learnt amplitude", learnt=True),
    Condition("clean, paper's skin", skin=PAPER),
    Condition("clean, unipolar", skin=Skin(drive="unipolar")),
    Condition("clean, parity", skin=Skin(parity=True, period_chips=300)),
    Condition("clean, 64 nodes", skin=LARGE),
    Condition("joining and leaving", talk=CHURN),
    Condition("joining and leaving, learnt amplitude", talk=CHURN, learnt=True),
    Condition("joining and leaving, paper's skin", talk=CHURN, skin=PAPER),
    Condition("two nodes", talk=TWO),
    Condition("noise, rho 12", Line(noise_v=0.112)),
    Condition("noise, rho 6", Line(noise_v=0.224), rough=True),
    Condition("noise, rho 6, joining and leaving", Line(noise_v=0.224), CHURN, rough=True),
)
"""Skins on a sound line, with more or less noise."""
TIMES = (
    Condition("skew 0.1 chip", Line(skew_chips=0.1)),
    Condition("skew 0.4 chip", Line(skew_chips=0.4), rough=True),
    Condition("a node 0.3 chip late", Line(late=((2, 0.3),)), FEW, rough=True),
    Condition("a node 0.6 chip late", Line(late=((2, 0.6),)), FEW, rough=True),
    Condition(
        "a node 0.6 chip late, two nodes", Line(late=((2, 0.6),)), Talk(speakers=(2, 9)), rough=True
    ),
    Condition("a node 2 chips late", Line(late=((2, 2.0),)), FEW, rough=True),
    Condition("edges jitter by 0.05 chip", Line(edge_jitter_chips=0.05)),
    Condition("edges jitter by 0.2 chip", Line(edge_jitter_chips=0.2), CHURN, rough=True),
    Condition("clock error 100 ppm", Line(clock_error=1e-4)),
    Condition("stretch 0.5 %", Line(stretch=0.005), CHURN, rough=True),
)
"""Chips that are not where they should be."""
VOLTAGES = (
    Condition("amplitudes spread by 10 %", Line(spread=0.1), CHURN),
    Condition("a node at 0.6 A", Line(gains=((2, 0.6),)), FEW),
    Condition("a node at 0.4 A", Line(gains=((2, 0.4),)), FEW, rough=True),
    Condition("a node at 1.5 A", Line(gains=((2, 1.5),)), FEW),
    Condition("a node at 4 A", Line(gains=((2, 4.0),)), FEW, rough=True),
    Condition("droop 20 %", Line(droop=0.2), CHURN),
    Condition("ripple 10 %, 300 Hz", Line(ripple=0.1, ripple_hz=300), FEW),
    Condition("rise 0.2, fall 0.4 chip", Line(rise_chips=0.2, fall_chips=0.4), FEW),
    Condition("low-pass 0.1 chip", Line(low_pass_chips=0.1)),
    Condition("low-pass 0.3 chip", Line(low_pass_chips=0.3), rough=True),
    Condition("low-pass 0.3 chip, one node", Line(low_pass_chips=0.3), ONE),
    Condition("low-pass 0.3 chip, one node alone", Line(low_pass_chips=0.3), ALONE),
    Condition(
        "low-pass 0.6 chip, joining and leaving", Line(low_pass_chips=0.6), CHURN, rough=True
    ),
    Condition("ringing 30 %", Line(ringing=0.3)),
    Condition("ringing 60 %, joining and leaving", Line(ringing=0.6), FEW, rough=True),
    Condition("high-pass 10 Hz", Line(high_pass_hz=10), CHURN),
    Condition("high-pass 100 Hz", Line(high_pass_hz=100), FEW),
    Condition("high-pass 500 Hz, two nodes", Line(high_pass_hz=500), TWO, rough=True),
    Condition("hum of A/3", Line(hum_v=0.1)),
    Condition("hum of A/3, two nodes", Line(hum_v=0.1), TWO),
    Condition("hum of 2 A", Line(hum_v=0.6), CHURN, rough=True),
    Condition("100 impulses/s of 1 V", Line(impulses_hz=100), FEW),
    Condition("1000 impulses/s of 1 V", Line(impulses_hz=1000), rough=True),
    Condition("1000 impulses/s of 1 V, two nodes", Line(impulses_hz=1000), TWO, rough=True),
    Condition(
        "50 impulses/s of 5 V, 2 chips",
        Line(impulses_hz=50, impulse_v=5, impulse_chips=2),
        rough=True,
    ),
    Condition("20 jumps/s of A", Line(steps_hz=20, step_v=0.3), FEW, rough=True),
    Condition("100 jumps/s of 2 A", Line(steps_hz=100, step_v=0.6), FEW, rough=True),
)
"""Levels that are not what they should be."""
RAILS = (
    Condition("offset 1.05 x rail", Line(offset_v=6.3)),
    Condition("offset 1.3 x rail", Line(offset_v=7.8)),
    Condition("offset -1.3 x rail, joining and leaving", Line(offset_v=-7.8), FEW),
    Condition("offset 1.3 x rail, nobody speaks", Line(offset_v=7.8), Talk(share=0)),
    Condition("offset 0.9 x rail", Line(offset_v=5.4), rough=True),
    Condition("offset 0.9 x rail, joining and leaving", Line(offset_v=5.4), CHURN, rough=True),
    Condition("at the rail at times", Line(steps_hz=3, step_v=9.0), FEW, rough=True),
    Condition("amplifier clips at 3 sqrt(n) A", Line(amplifier_v=3.6)),
    Condition("amplifier clips at 1.5 sqrt(n) A", Line(amplifier_v=1.8), rough=True),
)
"""Lines of which a part cannot be seen."""


def conditions() -> Iterator[Condition]:
    """All conditions; names begin with how frames are timed."""
    for name, digitizer in TIMINGS.items():
        for condition in SKINS + TIMES + VOLTAGES + RAILS:
            yield replace(condition, name=f"{name}: {condition.name}", digitizer=digitizer)
        for change, how in (
            ("5 losses/s", replace(digitizer, losses_hz=5)),
            ("8 bits", replace(digitizer, adc_bits=8)),
            ("16 samples per chip", replace(digitizer, samples_per_chip=16)),
        ):
            yield Condition(f"{name}: {change}", talk=FEW, digitizer=how)
        for ratio, rail_v in ((3, 3.6), (1.5, 1.8)):
            clipping = replace(digitizer, rail_v=rail_v)
            clips = f"{name}: rail at {ratio} sqrt(n) A"
            yield Condition(clips, digitizer=clipping, rough=ratio < 3)
        for order in (8, 24, 28, 32, 36, 40):
            skin = Skin(nodes=order - 1, order=order, period_chips=13 * order, amplitude_v=0.2)
            yield Condition(f"{name}: order {order}", talk=CHURN, skin=skin, digitizer=digitizer)
    yield from gap_conditions()


def gap_conditions() -> Iterator[Condition]:
    """Frames that begin where no raster says."""
    for order, skin in ORDERS.items():
        for words, talk in (("random", TWO), ("equal", TWO_EQUAL)):
            for moves, line in (
                ("jitter 1 chip", Line(start_jitter_chips=1)),
                ("jitter 3 chips", Line(start_jitter_chips=3)),
                ("slips", Line(slip_share=0.03)),
                ("jitter 3 chips, low-pass", Line(start_jitter_chips=3, low_pass_chips=0.2)),
            ):
                name = f"gap: order {order}, two nodes, {words} words, {moves}"
                yield Condition(name, line, talk, skin, BLIND)
    unsteady = Line(start_jitter_chips=3, stretch=0.1)
    for name, line, talk in (
        ("jitter 3 chips", Line(start_jitter_chips=3), Talk()),
        ("jitter 3 chips, joining and leaving", Line(start_jitter_chips=3), CHURN),
        ("stretch 10 %", Line(stretch=0.1), Talk()),
        ("stretch 10 %, jitter 3 chips, joining and leaving", unsteady, CHURN),
        ("stretch 10 %, jitter 3 chips, two nodes", unsteady, TWO),
    ):
        yield Condition(f"gap: {name}", line, talk, digitizer=BLIND)


class Decoded(NamedTuple):
    """A frame as published: its start, chips, its words, and which nodes count as broken."""

    start_chips: float
    words: Words
    invalid: Bools


class Tally(NamedTuple):
    """Counts of words; see the module's docstring.

    tied: right words with a flag in frames that tie. silences, silent_flagged: of nodes that were
    rightly published as silent, all and those with a flag.
    """

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
    silences: int = 0
    silent_flagged: int = 0

    @property
    def unflagged(self) -> int:
        return self.missed + self.wrong + self.invented

    @property
    def flagged_share(self) -> float:
        return self.flagged / max(self.right + self.flagged, 1)

    @property
    def silent_flagged_share(self) -> float:
        return self.silent_flagged / max(self.silences, 1)


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
    config, writer = _config(recording, learnt), PacketWriter()
    pipeline = Pipeline(config, background=False)
    pipeline.feed(writer.encode(introduction(config, recording.digitizer)), 0.0)
    if pipeline.problem:
        raise ValueError(pipeline.problem)
    heard = []
    for _, t_host, data in packets(recording, writer):
        for frame in pipeline.feed(data, t_host):
            heard.append((frame, pipeline.health.invalid.copy()))
    heard += [(frame, pipeline.health.invalid) for frame in pipeline.flush()]
    chip_s = recording.skin.chip_s
    return [Decoded(frame.t_start / chip_s, frame.words, bad) for frame, bad in heard]


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
        tally = _count(
            truth, heard.get(number), blind and rival(recording.skin, truth.codes) is not None
        )
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
    phantom = sum(
        int(np.count_nonzero(frame.words.active & never & ~_flags(frame))) for frame in decoded
    )
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
        "silences": ~spoke & ~active,
        "silent_flagged": ~spoke & ~active & flag & (not tie),
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


def rival(skin: Skin, codes: Ints) -> tuple[int, Ints] | None:
    """Another start, so many chips later, and the words that give exactly the same waveform there.

    Bipolar nodes without parity; None where there is no such pair.
    """
    chips = skin.waveforms(codes).sum(axis=0) / skin.amplitude_v
    rows = np.arange(skin.first_row, skin.first_row + skin.nodes)
    signs = np.array([row_sign(int(row), skin.sign_seed) for row in rows])
    sent = skin.polarity * signs[:, None] * code_book(skin.order)[rows].astype(float)
    for shift in (*range(-MOST_SHIFT, 0), *range(1, MOST_SHIFT + 1)):
        cut = chips[:shift] if shift > 0 else chips[shift:]
        if not chips.any() or cut.any():
            continue
        moved = np.roll(chips, -shift).reshape(-1, skin.order)
        levels = moved @ sent.T / skin.order
        spoke = np.abs(levels).mean(axis=0) > 0.5
        if np.allclose(np.sign(levels) * spoke @ sent, moved):
            values = (levels > 0).T @ 2 ** np.arange(skin.bits - 1, -1, -1)
            return shift, np.where(spoke, values, SILENT)
    return None


def main() -> None:
    report = Report("doubt", "Words not flagged, on an independent line", QUICK or bool(ONLY))
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of the processes
    chosen = [condition for condition in conditions() if ONLY in condition.name]
    jobs = [Job(c, seed) for c in chosen for seed in range(RECORDINGS)]
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        results = pool.map(run, jobs, chunksize=1)
    tallies = {
        condition.name: total(
            [tally for job, (tally, _) in zip(jobs, results, strict=True) if job[0] == condition]
        )
        for condition in chosen
    }
    report.table(
        ["condition", "words", "right", "right but flagged", "missed", "wrong flagged",
         "wrong not flagged", "invented not flagged", "lost", "rail silent", "phantom", "tied",
         "silent", "silent but flagged"],
        [[name, *tally] for name, tally in tallies.items()],
        keep=False,
    )  # fmt: skip
    if ONLY:
        for job, (_, complaints) in zip(jobs, results, strict=True):
            for complaint in complaints[:SHOWN]:
                print(f"{job.condition.name}, recording {job.seed}:{complaint}")
    everything = total(list(tallies.values()))
    sound = total([tallies[condition.name] for condition in chosen if not condition.rough])
    report.finish(
        picture(tallies),
        words=everything.words,
        unflagged=everything.unflagged,
        rail_silent=everything.rail_silent,
        phantom=everything.phantom,
        right_flagged_share=round(sound.flagged_share, 4),
        silent_flagged_share=round(sound.silent_flagged_share, 4),
    )


def picture(tallies: dict[str, Tally]) -> Figure:
    """Shares of the words, of each condition in which not nearly all of them are right."""
    tallies = {name: t for name, t in tallies.items() if t.right < ALL_RIGHT * t.words}
    figure = Figure(figsize=(9, 0.16 * len(tallies) + 1))
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
    axes.set_ylim(len(tallies) - 0.5, -0.5)
    axes.tick_params(axis="y", labelsize=7)
    axes.set_xlabel("share of the words")
    axes.legend(ncols=len(kinds), fontsize=7, loc="lower center", bbox_to_anchor=(0.4, 1.0))
    return figure


if __name__ == "__main__":
    main()
