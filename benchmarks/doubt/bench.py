# SPDX-License-Identifier: Apache-2.0

"""Runs the conditions of all SOURCES on all cores, and reports; see the package."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from multiprocessing.pool import Pool
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from .. import style
from ..report import QUICK, ROOT, Report
from . import lines, mixtures, printed, stamps, touches, zeros
from .kept import Kept, Result, loaded_code
from .tally import Condition, Tally, total
from .words import LineCondition

SOURCES: tuple[Callable[[], Iterator[Condition]], ...] = (
    lines.conditions,
    mixtures.conditions,
    touches.conditions,
    stamps.conditions,
    zeros.conditions,
    printed.conditions,
)
"""Where conditions come from."""
ONLY = os.environ.get("ONLY", "")
FRAMES = 60 if QUICK else 250
"""Frames of one recording: enough for a decoder to learn the line, and then be surprised."""
RECORDINGS = 1 if QUICK else 4
FATES = {
    "right": style.BLUE,
    "flagged": style.SKY,
    "tied": style.PALE,
    "wrong_flagged": style.YELLOW,
    "lost": style.GREY,
    "unflagged": style.FALSE,
}
"""What may become of words, with their colours; see Tally."""
TITLES = {
    "right": "right",
    "flagged": "right, flagged",
    "tied": "flagged: two explain it",
    "wrong_flagged": "wrong, flagged",
    "lost": "frame rejected",
    "unflagged": "false, not flagged",
    "gap": "gap timing",
    "sparse": "sparse codes",
    "mixture": "mixtures",
    "means": "chip means",
}
SEARCHED = "gap:"
"""Frames of these are searched for, which takes ten times as long: half as many recordings."""
FEW = 3
"""Speakers up to which a frame has few: shifted frames and twins of rows are likeliest there."""
SHOWN = 5
"""False claims of a recording that are listed."""
PROGRESS_S = 20.0
"""From one line that says how far the run is to the next."""


class Job(NamedTuple):
    """Is one recording of a condition, to be made and decoded."""

    condition: Condition
    seed: int


def run(job: Job) -> tuple[Job, Result]:
    """Counts of one recording, and its first false claims."""
    tally, complaints = job.condition.run(FRAMES, job.seed)
    return job, (tally, complaints[:SHOWN])


def jobs_of(conditions: list[Condition]) -> list[Job]:
    """Return all recordings: the first of each condition, then the second ones."""
    return [
        Job(condition, seed)
        for seed in range(RECORDINGS)
        for condition in conditions
        if not (seed % 2 and condition.name.startswith(SEARCHED))
    ]


def run_all(jobs: list[Job], kept: Kept) -> None:
    """Run what is not kept yet, on all cores; shows how far it is, and all false claims."""
    rest = [job for job in jobs if (job.condition.name, job.seed) not in kept.found]
    false, shown = 0, time.monotonic()
    with _pool() as pool:
        for count, (job, result) in enumerate(pool.imap_unordered(run, rest), 1):
            kept.add(job.condition.name, job.seed, result)
            tally, complaints = result
            false += tally.false
            for complaint in complaints:
                print(f"{job.condition.name}, recording {job.seed}:{complaint}")
            if time.monotonic() > shown + PROGRESS_S:
                shown = time.monotonic()
                done = len(jobs) - len(rest) + count
                print(f"{done} of {len(jobs)} recordings, {false} claims false", flush=True)


def _pool() -> Pool:
    """Return a process for each core; they leave Ctrl-C to this one."""
    context, cores = multiprocessing.get_context("spawn"), len(os.sched_getaffinity(0))
    return context.Pool(cores, signal.signal, (signal.SIGINT, signal.SIG_IGN))


def main() -> None:
    report = Report("doubt", "Claims that are false and not flagged", QUICK or bool(ONLY))
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of the processes
    chosen = [some for source in SOURCES for some in source() if ONLY in some.name]
    jobs = jobs_of(chosen)
    code = f"{loaded_code()} {FRAMES}"
    path = ROOT / "build" / "benchmarks" / f"doubt{'_quick' if QUICK else ''}.jsonl"
    with Kept(path, code) as kept:
        try:
            run_all(jobs, kept)
        except KeyboardInterrupt:
            raise SystemExit(f"{path} has what is done: the same command goes on there") from None
        found = kept.found
    each: dict[str, list[Tally]] = {condition.name: [] for condition in chosen}
    for job in jobs:
        each[job.condition.name].append(found[job.condition.name, job.seed][0])
    tallies = {name: total(some) for name, some in each.items()}
    report.table(
        ["condition", *(field.replace("_", " ") for field in Tally._fields)],
        [[name, *tally] for name, tally in tallies.items()],
        keep=False,
    )
    report.table(["kind", *FATES], fates(tallies))
    everything = total(tallies.values())
    sound = [some for some in chosen if isinstance(some, LineCondition) and not some.rough]

    def of(is_meant: Callable[[LineCondition], bool]) -> Tally:
        return total([Tally(), *(tallies[some.name] for some in sound if is_meant(some))])

    plain = of(lambda some: not some.skin.scramble)
    few = of(lambda some: not some.skin.scramble and some.most_speakers <= FEW)
    scrambled = of(lambda some: some.skin.scramble)
    report.finish(
        picture(report.tables),
        words=everything.words,
        claims=everything.words + everything.silences + everything.claims,
        unflagged=everything.unflagged,
        rail_silent=everything.rail_silent,
        phantom=everything.phantom,
        stale_claims=everything.stale_claims,
        false_zeros=everything.false_zeros,
        stamps_off=everything.stamps_off,
        tares=everything.tares,
        fast_frames=everything.fast_frames,
        decode_silent=everything.decode_silent,
        right_flagged_share=round(plain.flagged_share, 4),
        silent_flagged_share=round(plain.silent_flagged_share, 4),
        plain_few_flagged_share=round(few.doubted_share, 4),
        scrambled_flagged_share=round(scrambled.flagged_share, 4),
        scrambled_silent_flagged_share=round(scrambled.silent_flagged_share, 4),
    )
    path.unlink()


def fates(tallies: dict[str, Tally]) -> list[list[str | float]]:
    """What became of the words of each condition, shares, by kind; rows of the table that is kept.

    The kind is how frames are timed, or where they come from: what names begin with.
    """
    rows = list[list[str | float]]()
    for name, tally in tallies.items():
        words = sum(getattr(tally, fate) for fate in FATES)
        if words:
            kind = re.split(r"[: ]", name)[0]
            rows.append([kind, *(getattr(tally, fate) / words for fate in FATES)])
    return rows


def picture(tables: list[list[list[Any]]]) -> Figure:
    """Draw what became of the words, a panel for each kind, conditions sorted by the right ones."""
    shares: dict[str, list[list[float]]] = {}
    for kind, *row in tables[0][1:]:
        shares.setdefault(kind, []).append(row)
    figure = style.sheet(640)
    panels = figure.subplots(2, 3, sharey=True).flat
    for axes, kind in zip(panels, shares, strict=False):
        rows = 100 * np.array(sorted(shares[kind], reverse=True))
        at = np.linspace(0, 100, len(rows))
        axes.stackplot(at, rows[:, :-1].T, colors=[*FATES.values()][:-1], lw=0)
        false = rows[:, -1] > 0
        axes.plot(at[false], np.full(false.sum(), 97.0), "v", color=style.FALSE, ms=11)
        text = f"{TITLES.get(kind, kind)}: {len(rows)}, {false.sum()} false"
        axes.set_title(text, color=style.FALSE if false.any() else style.BLACK)
        axes.set(xlim=(0, 100), ylim=(0, 100))
        axes.grid(visible=False)
    for axes in figure.axes[3:]:
        axes.set_xlabel("conditions, %")
    for axes in (figure.axes[0], figure.axes[3]):
        axes.set_ylabel("words, %")
    last = figure.axes[-1]
    last.axis("off")
    for fate, colour in FATES.items():
        last.plot(
            [], [], "v" if fate == "unflagged" else "s", color=colour, label=TITLES[fate], ms=12
        )
    last.legend(loc="center left")
    return figure
