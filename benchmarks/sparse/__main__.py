# SPDX-License-Identifier: Apache-2.0

"""Sparse codes: which frames are certain, and whether anything certain is false.

    make bench-sparse      QUICK=1: fewer frames and books

Nodes speak at random, with random words, a tolerance of their amplitudes and noise; in other
conditions words are equal, those who speak are neighbours (a hand), some are weak (0.6 A), a tone
is on the line, a node is late by 1 to 8 chips, the frame is, a sample is lost or doubled, the
amplifier clips, or nodes have another seed than the host believes. `certified_share` is that of
frames without doubt, of sound ones of ρ ≥ 15 in which up to 0.45 of the chips (64 and more) speak;
"false" and `unflagged` are words and silences that are claimed without doubt and were not sent.

`capacity_912`: nodes that may speak in a frame of 912 chips. Times are those of detection in the
kernel, per frame of 4,000 nodes at 912 chips. `cpu_ratio_900` is the CPU time of the driver node's
process on a port, with 4,000 nodes of which 8 % speak, over that with 900 orthogonal ones that all
speak, in as many chips (`thousand_skin.yaml`), with one subscriber each, as bench-ros measures it;
so are `p50_ms`, from the last byte of a frame to the subscriber's callback, and `p50_ms_floor`.
`decoder_ratio_900` is that of decoding alone, of recorded bytes without the first frames, in which
the noise is learnt, and without pauses; `decoder_ratio_idle` the same of 1.3 %, as many as beat
their hearts in a frame.

`words`: of 4,000 nodes of which 8 % speak, at several ρ; `words_wrong`: claims of these frames, of
words or silence, that are false. `hug_ms`: from the touch of all 4,000 nodes at once until every
taxel has its new value, by turns; `release_ms`: from their release until all are certain; see hug.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from benchmarks import ros
from benchmarks.report import QUICK, Report, be_alone, medians_s
from benchmarks.skip import record
from benchmarks.sparse.hug import Hug, hug
from tactile_cdma.base.arrays import Bools, Floats, Floats32
from tactile_cdma.code.detect import Detector
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.separate import NodeLevels
from tactile_cdma.code.transform import chips_of
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.framing.marked_timing import MarkedFrame, MarkedLine
from tactile_cdma.framing.sparse_timing import (
    LEARNT,
    SparseRecogniser,
    capacity,
    certificate,
)
from tactile_cdma.words.decode import Words, decode, silent

BOOKS = [(64, 32, 10), (256, 64, 10), (1000, 128, 10), (4000, 912, 10)]
"""Nodes, chips per bit, bits."""
if not QUICK:
    BOOKS += [(40, 16, 10), (256, 48, 10), (256, 64, 8), (256, 64, 16), (2000, 256, 12)]
    BOOKS += [(16_000, 912, 10), (4000, 2048, 10)]
LOADS = (0.02, 0.25, 0.45) if QUICK else (0.0, 0.02, 0.1, 0.25, 0.35, 0.45, 0.55, 0.7, 1.0)
"""Nodes that speak in a frame, of the chips per bit; at least one but for 0."""
RHOS = (15, 100) if QUICK else (5, 15, 50, 100, 1000)
FRAMES = {912: 12, 2048: 6} if QUICK else {912: 40, 2048: 15}
"""By chips per bit, of every condition; of shorter codes OTHERS."""
OTHERS = 60 if QUICK else 200
WORDS = 10**5 if QUICK else 10**7
"""Words of which none may be wrong."""
CONDITIONS = (
    *("random", "equal words", "neighbours", "weak nodes", "tone", "late node", "late frame"),
    *("lost sample", "doubled sample", "clipping", "other seed", "everybody"),
)
SOUND = ("random", "equal words", "neighbours")
TOLERANCE = 0.034


@dataclass
class Tally:
    """frames; of them certain; words and silences claimed without doubt, and those not sent.

    A frame is certain if it was not flagged as a whole, and all its words are.
    """

    frames: int = 0
    certain: int = 0
    claims: int = 0
    false: int = 0

    def add(self, words: Words, active: Bools, codes: np.ndarray) -> None:
        sure = ~words.doubtful
        wrong = (words.active != active) | (active & (words.codes != codes))
        self.frames += 1
        self.certain += int(sure[active].all() and sure.any())
        self.claims += int(sure.sum())
        self.false += int((sure & wrong).sum())

    @property
    def share(self) -> float:
        return self.certain / max(1, self.frames)


class Skin:
    """Makes frames of a book, and has them read."""

    def __init__(self, nodes: int, order: int, bits: int, rho: float) -> None:
        fields = {"amplitude_v": 1.0, "chip_s": 1e-6, "frame_period_s": 1.0, "codes": "sparse"}
        self.spec = FrameSpec(nodes, bits, order, **fields)  # type: ignore[arg-type]
        self.other = FrameSpec(nodes, bits, order, sign_seed=9, **fields)  # type: ignore[arg-type]
        self.rho, self.rng = rho, np.random.default_rng([nodes, order, bits, int(rho)])
        self.recogniser = SparseRecogniser(MarkedLine(self.spec, 1 / self.spec.chip_s))
        for _ in range(2 * LEARNT):
            self.frame("random", min(2, capacity(self.spec)), Tally())

    def chips(self, codes: np.ndarray, level: Floats32, spec: FrameSpec) -> Floats32:
        """(k·N,) V, of words (n,) with these amplitudes, 0 for those who are silent."""
        speak = np.flatnonzero(level)
        weights = 1 << np.arange(spec.bits - 1, -1, -1)
        bits = np.where(codes[speak] & weights[:, None], 1, -1)
        rows = np.zeros((spec.line_bits, spec.row_count), np.float32)
        rows[:, 1 + speak] = bits * level[speak] * spec.signs[speak]
        return chips_of(rows, spec).ravel()

    def frame(self, condition: str, speakers: int, tally: Tally) -> Words:
        """One frame under a condition; tallies what is made of it."""
        spec, rng = self.spec, self.rng
        chosen = rng.permutation(spec.nodes)[:speakers]
        if condition == "neighbours":
            chosen = np.arange(speakers) + rng.integers(spec.nodes - speakers + 1)
        if condition == "everybody":
            chosen = np.arange(spec.nodes)
        active = np.zeros(spec.nodes, np.bool_)
        active[chosen] = True
        codes = rng.integers(1 << spec.bits, size=spec.nodes)
        if condition == "equal words":
            codes[:] = codes[0]
        level = (active * (1 + rng.uniform(-TOLERANCE, TOLERANCE, spec.nodes))).astype(np.float32)
        if condition == "weak nodes":
            level[chosen[: 1 + speakers // 4]] *= 0.6
        if condition == "late node":
            late = np.where(np.arange(spec.nodes) == chosen[0], level, 0)
            line = self.chips(codes, level - late, spec)
            line = line + np.roll(self.chips(codes, late, spec), self._some_chips())
        elif condition == "other seed":
            odd = np.where(np.arange(spec.nodes) == chosen[0], level, 0)
            line = self.chips(codes, level - odd, spec) + self.chips(codes, odd, self.other)
        else:
            line = self.chips(codes, level, spec)
        noise = rng.normal(0.3, np.sqrt(spec.order) / self.rho, line.size)
        words = self._read(self._disturbed(line, condition) + noise)
        tally.add(words, active, codes)
        return words

    def _some_chips(self) -> int:
        return int(self.rng.integers(1, 9) * self.rng.choice([-1, 1]))

    def _disturbed(self, line: Floats32, condition: str) -> Floats32:
        if condition == "tone":
            turn = 2 * np.pi * self.rng.uniform(0, 20) * np.arange(line.size) / self.spec.order
            return (line + self.rng.uniform(0, 1) * np.sin(turn + self.rng.uniform(0, 6))).astype(
                np.float32
            )
        at = int(self.rng.integers(line.size))
        if condition == "late frame":
            return np.roll(line, self._some_chips())
        if condition == "lost sample":
            return np.append(np.delete(line, at), np.float32(0))
        if condition == "doubled sample":
            return np.insert(line, at, line[at])[:-1]
        if condition == "clipping":
            most = np.float32(self.rng.uniform(0.5, 3) * np.std(line))
            return np.clip(line, -most, most)
        return line

    def _read(self, line: Floats) -> Words:
        verdict = self.recogniser.recognise(MarkedFrame(0, line, True))
        heard = verdict.frame
        if heard is None:
            return silent(self.spec.nodes, 0.0).doubted(np.ones(self.spec.nodes, np.bool_))
        levels: NodeLevels | None = heard.levels
        words = decode(levels, self.spec) if levels else silent(self.spec.nodes, 0.0)
        return words if heard.doubtful is None else words.doubted(heard.doubtful)


def conditions(order: int) -> Iterator[tuple[str, float]]:
    """Conditions, and loads in which they are tried."""
    for condition in CONDITIONS:
        loads: tuple[float, ...] = (0.0, 0.1, 0.4) if condition not in SOUND else LOADS
        for load in loads if condition != "everybody" else (1.0,):
            yield condition, load


def main() -> None:
    report = Report("sparse", "Sparse codes: what is certain, and what of it is false")
    everything, sound = Tally(), Tally()
    by_load: dict[tuple[int, int, int], dict[float, Tally]] = {}
    by_condition: dict[str, Tally] = {condition: Tally() for condition in CONDITIONS}
    with threadpool_limits(1):
        for book in BOOKS:
            for rho in RHOS:
                skin = Skin(*book, rho)
                for condition, load in conditions(book[1]):
                    measured = Tally()
                    speakers = min(max(1, round(load * book[1])) if load else 0, book[0])
                    if condition not in SOUND:
                        speakers = max(1, speakers)
                    for _ in range(FRAMES.get(book[1], OTHERS)):
                        skin.frame(condition, speakers, measured)
                    into = [everything, by_condition[condition]]
                    if condition == "random" and rho >= 15:
                        into.append(by_load.setdefault(book, {}).setdefault(load, Tally()))
                    if condition in SOUND and rho >= 15 and book[1] >= 64 and load <= 0.45:
                        into.append(sound)
                    for tally in into:
                        add(tally, measured)
        report.table(
            ["nodes", "chips", "bits", "capacity", *(f"certain at {load:g} N" for load in LOADS)],
            [
                [*book, capacity(Skin(*book, 100).spec), *(tallies[load].share for load in LOADS)]
                for book, tallies in by_load.items()
            ],
        )
        report.table(
            ["condition", "frames", "certain", "claims", "false"],
            [[name, t.frames, t.share, t.claims, t.false] for name, t in by_condition.items()],
        )
        words = many_words()
        took = times()
        busy, idle = decoder_ratios()
    cpu_ratio, driver, floor = live()
    hugged = hug(ros.CASES[4000])
    report.table(["speak", "µs"], [[speakers, 1e6 * each] for speakers, each in took.items()])
    report.finish(
        figure(by_load, took, hugged),
        frames=everything.frames,
        claims=everything.claims,
        certified_share=sound.share,
        unflagged=everything.false,
        capacity_912=capacity(Skin(4000, 912, 10, 100).spec),
        us_20=1e6 * took[20],
        us_320=1e6 * took[320],
        cpu_ratio_900=cpu_ratio,
        decoder_ratio_900=busy,
        decoder_ratio_idle=idle,
        words=WORDS,
        words_wrong=words.false,
        hug_ms=1e3 * hugged.touched_s,
        release_ms=1e3 * hugged.released_s,
        hug_false=hugged.false,
        p50_ms=driver.p50_ms,
        p50_ms_floor=floor.p50_ms,
    )


def add(tally: Tally, other: Tally) -> None:
    """Count what another tally has counted."""
    tally.frames += other.frames
    tally.certain += other.certain
    tally.claims += other.claims
    tally.false += other.false


def many_words() -> Tally:
    """Frames of 4,000 nodes of which 8 % speak."""
    found, speakers = Tally(), 320
    for rho in RHOS:
        if rho >= 15:
            skin = Skin(4000, 912, 10, rho)
            for _ in range(-(-WORDS // speakers // sum(rho >= 15 for rho in RHOS))):
                skin.frame("random", speakers, found)
    return found


def times() -> dict[int, float]:
    """Median time of detection by how many speak, of 4,000 nodes on 912 chips, s."""
    skin = Skin(4000, 912, 10, 100)
    spec, detector = skin.spec, Detector(skin.spec, certificate(skin.spec))
    frames = {}
    for speakers in (0, 1, 20, 100, 320, 550):
        level = np.zeros(spec.nodes, np.float32)
        level[skin.rng.permutation(spec.nodes)[:speakers]] = 1
        line = skin.chips(skin.rng.integers(1024, size=spec.nodes), level, spec)
        line += skin.rng.normal(0, np.sqrt(spec.order) / 100, line.size).astype(np.float32)
        frames[speakers] = line.reshape(spec.line_bits, spec.order)
    named = {str(speakers): partial(detector.detect, chips) for speakers, chips in frames.items()}
    found = medians_s(named, 11 if QUICK else 101, clock=time.process_time, least_s=0.02)
    return {int(speakers): each for speakers, each in found.items()}


def live() -> tuple[float, ros.Result, ros.Result]:
    """CPU of a driver of 4,000 nodes over that of 900, by turns; its last run, and the floor."""
    be_alone()
    ratios = []
    for _ in range(3):
        driver, orthogonal = (ros.measure(ros.DRIVER, nodes) for nodes in (4000, 900))
        ratios.append(driver.cpu / orthogonal.cpu)
    return float(np.median(ratios)), driver, ros.measure(ros.FLOOR, 4000)


def decoder_ratios() -> tuple[float, float]:
    """CPU time of all of the decoder, busy and idle, over that of 900 orthogonal nodes."""
    recordings = []
    for nodes, share in ((4000, ros.PRESSED[4000]), (4000, 1 / 78), (900, 1.0)):
        recording = record(SkinConfig.of(ros.CASES[nodes]), share, False, 150)
        chunks = [(data, t_host) for t_host, data in recording.reads]
        recordings.append((recording.config, chunks))
    spent = [[replay(*each) for each in recordings] for _ in range(5 if QUICK else 15)]
    busy, idle, orthogonal = np.median(spent, axis=0)
    return float(busy / orthogonal), float(idle / orthogonal)


def replay(config: SkinConfig, chunks: list[tuple[bytes, float]]) -> float:
    """CPU time per frame of a decoder that has seen a quarter of the chunks, s."""
    pipeline = Pipeline(config)
    for data, t_host in chunks[: len(chunks) // 4]:
        pipeline.feed(data, t_host)
    frames, begin_s = pipeline.counters.frames, time.thread_time()
    for data, t_host in chunks[len(chunks) // 4 :]:
        pipeline.feed(data, t_host)
    return (time.thread_time() - begin_s) / (pipeline.counters.frames - frames)


def figure(
    by_load: dict[tuple[int, int, int], dict[float, Tally]], took: dict[int, float], hugged: Hug
) -> Figure:
    drawing = Figure(figsize=(11, 8), layout="constrained")
    (loads, detection), (shares, groups) = drawing.subplots(2, 2)
    for (nodes, chips, bits), tallies in by_load.items():
        certain = [tally.share for tally in tallies.values()]
        loads.plot(list(tallies), certain, "o-", label=f"{nodes} on {chips}, {bits} bits")
    loads.set(xlabel="nodes that speak / chips per bit", ylabel="share of frames that are certain")
    loads.legend(fontsize="small")
    detection.plot(list(took), [1e6 * each for each in took.values()], "o-")
    detection.set(
        xlabel="nodes that speak, of 4,000 on 912 chips", ylabel="detection, µs per frame"
    )
    shares.plot(hugged.t_s, 100 * hugged.right, label="that have their present value")
    shares.plot(hugged.t_s, 100 * hugged.certain, label="whose value is certain now")
    shares.set(ylabel="taxels, %")
    shares.legend(fontsize="small")
    groups.step(hugged.t_s, hugged.groups)
    groups.set(ylabel="groups that transmit by turns")
    for axes in (shares, groups):
        axes.set(xlim=(-0.1, 4), xlabel="s after 4,000 nodes were touched at once; released at 1 s")
    return drawing


if __name__ == "__main__":
    main()
