# SPDX-License-Identifier: Apache-2.0

"""Runs the conditions of all SOURCES on all cores, and reports; see the package."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ..report import QUICK, Report
from . import lines, mixtures, stamps, touches, zeros
from .tally import Condition, Tally, total

SOURCES: tuple[Callable[[], Iterator[Condition]], ...] = (
    lines.conditions,
    mixtures.conditions,
    touches.conditions,
    stamps.conditions,
    zeros.conditions,
)
"""Where conditions come from."""
ONLY = os.environ.get("ONLY", "")
FRAMES = 60 if QUICK else 250
"""Frames of one recording: enough for a decoder to learn the line, and then be surprised."""
RECORDINGS = 1 if QUICK else 4
ALL_RIGHT = 0.99
"""Share of right words beyond which a condition is left out of the picture."""
SHOWN = 5
"""False claims of a condition that are listed with ONLY."""


class Job(NamedTuple):
    """One recording of a condition."""

    condition: Condition
    seed: int


def run(job: Job) -> tuple[Tally, list[str]]:
    """Counts of one recording, and its first false claims."""
    return job.condition.run(FRAMES, job.seed)


def main() -> None:
    report = Report("doubt", "Claims that are false and not flagged", QUICK or bool(ONLY))
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of the processes
    chosen = [some for source in SOURCES for some in source() if ONLY in some.name]
    jobs = [Job(condition, seed) for condition in chosen for seed in range(RECORDINGS)]
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        results = pool.map(run, jobs, chunksize=1)
    each: dict[str, list[Tally]] = {condition.name: [] for condition in chosen}
    for job, (tally, complaints) in zip(jobs, results, strict=True):
        each[job.condition.name].append(tally)
        if ONLY:
            for complaint in complaints[:SHOWN]:
                print(f"{job.condition.name}, recording {job.seed}:{complaint}")
    tallies = {name: total(some) for name, some in each.items()}
    report.table(
        ["condition", *(field.replace("_", " ") for field in Tally._fields)],
        [[name, *tally] for name, tally in tallies.items()],
        keep=False,
    )
    everything = total(tallies.values())
    sound = total([Tally(), *(tallies[some.name] for some in chosen if not some.rough)])
    report.finish(
        picture(tallies),
        words=everything.words,
        unflagged=everything.unflagged,
        rail_silent=everything.rail_silent,
        phantom=everything.phantom,
        stale_claims=everything.stale_claims,
        false_zeros=everything.false_zeros,
        stamps_off=everything.stamps_off,
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
    axes.set_ylim(max(len(tallies), 1) - 0.5, -0.5)
    axes.tick_params(axis="y", labelsize=7)
    axes.set_xlabel("share of the words")
    axes.legend(ncols=len(kinds), fontsize=7, loc="lower center", bbox_to_anchor=(0.4, 1.0))
    return figure
