# SPDX-License-Identifier: Apache-2.0

"""Frames of sparse codes under a condition, and what is claimed of them."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from benchmarks.report import QUICK
from tactile_cdma.base.arrays import Bools, Floats, Floats32
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import chips_of
from tactile_cdma.framing.load import capacity
from tactile_cdma.words.words import Words, nobody, silent
from test.support.single_frames import SingleReader

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
SPEAKERS = 320
"""8 % of 4,000 nodes."""
CONDITIONS = (
    *("random", "equal words", "neighbours", "weak nodes", "tone", "late node", "late frame"),
    *("lost sample", "doubled sample", "clipping", "other seed", "everybody"),
)
SOUND = ("random", "equal words", "neighbours")
TOLERANCE = 0.034
LEARNING = 16
"""Frames after which the noise is known."""
MANY = "many words"
AT_ONCE = 200
"""Frames of MANY in one job."""
PROGRESS_S = 20.0
"""From one line that says how far the run is to the next."""


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

    def __iadd__(self, other: Tally) -> Self:
        self.frames += other.frames
        self.certain += other.certain
        self.claims += other.claims
        self.false += other.false
        return self


class Skin:
    """Makes frames of a book, and has them read."""

    def __init__(self, nodes: int, order: int, bits: int, rho: float, seed: int = 0) -> None:
        fields = {"amplitude_v": 1.0, "chip_s": 1e-6, "frame_period_s": 1.0, "codes": "sparse"}
        self.spec = FrameSpec(nodes, bits, order, **fields)  # type: ignore[arg-type]
        self.other = FrameSpec(nodes, bits, order, sign_seed=9, **fields)  # type: ignore[arg-type]
        self.rho, self.rng = rho, np.random.default_rng([nodes, order, bits, int(rho), seed])
        self.reader = SingleReader(self.spec, 1 / self.spec.chip_s)
        for _ in range(LEARNING):
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
        """Make one frame under a condition; tallies what is made of it."""
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
        frame = self.reader.read(line.astype(np.float32))
        if frame is None:
            return replace(silent(self.spec.nodes, 0.0), doubtful=~nobody(self.spec.nodes))
        return silent(self.spec.nodes, 0.0) if frame.words is None else frame.words


def conditions(order: int) -> Iterator[tuple[str, float]]:
    """Conditions, and loads in which they are tried."""
    for condition in CONDITIONS:
        loads: tuple[float, ...] = (0.0, 0.1, 0.4) if condition not in SOUND else LOADS
        for load in loads if condition != "everybody" else (1.0,):
            yield condition, load


class Job(NamedTuple):
    """Is work on a book: frames under all conditions, or so many of MANY words."""

    book: tuple[int, int, int]
    rho: float
    seed: int = 0
    many: int = 0


def jobs() -> list[Job]:
    """Return all there is to do, the longest first."""
    found = [Job(book, rho) for book in BOOKS for rho in RHOS]
    found.sort(key=lambda job: job.book[0] * job.book[1], reverse=True)
    sound = [rho for rho in RHOS if rho >= 15]
    for rho in sound:
        left, seed = -(-WORDS // SPEAKERS // len(sound)), 1
        while left > 0:
            found.append(Job((4000, 912, 10), rho, seed, min(left, AT_ONCE)))
            left, seed = left - AT_ONCE, seed + 1
    return found


def run(job: Job) -> tuple[Job, dict[tuple[str, float], Tally]]:
    """Return what is claimed under each condition and load."""
    skin, found = Skin(*job.book, job.rho, job.seed), {}
    if job.many:
        found[MANY, SPEAKERS / job.book[1]] = many = Tally()
        for _ in range(job.many):
            skin.frame("random", SPEAKERS, many)
        return job, found
    nodes, order, _ = job.book
    for condition, load in conditions(order):
        found[condition, load] = tally = Tally()
        speakers = min(max(1, round(load * order)) if load else 0, nodes)
        if condition not in SOUND:
            speakers = max(1, speakers)
        for _ in range(FRAMES.get(order, OTHERS)):
            skin.frame(condition, speakers, tally)
    return job, found


def run_all() -> Iterator[tuple[Job, dict[tuple[str, float], Tally]]]:
    """Run all jobs, on all cores; shows how far it is."""
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of the processes
    everything, shown = jobs(), time.monotonic()
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        for count, done in enumerate(pool.imap_unordered(run, everything), 1):
            if time.monotonic() > shown + PROGRESS_S:
                shown = time.monotonic()
                print(f"{count} of {len(everything)} parts", flush=True)
            yield done
