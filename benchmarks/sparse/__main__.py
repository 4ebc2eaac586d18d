# SPDX-License-Identifier: Apache-2.0

"""Sparse codes: which frames are certain, and whether anything certain is false.

    make bench-sparse      QUICK=1: fewer frames and books; all of it takes ten minutes

Nodes speak at random, with random words, a tolerance of their amplitudes and noise; in other
conditions words are equal, those who speak are neighbours (a hand), some are weak (0.6 A), a tone
is on the line, a node is late by 1 to 8 chips, the frame is, a sample is lost or doubled, the
amplifier clips, or nodes have another seed than the host believes. `certified_share` is that of
frames without doubt, of sound ones of ρ ≥ 15 in which up to 0.45 of the chips (64 and more) speak;
"false" and `unflagged` are words and silences that are claimed without doubt and were not sent.

`capacity_912`: nodes that may speak in a frame of 912 chips. Times are those of reading a frame of
4,000 nodes at 912 chips in the kernel, from chips to certified words. `cpu_ratio_900` is the CPU
time of the driver node's process on a port, with 4,000 nodes of which 8 % speak, over that with 900
orthogonal ones that all speak, in as many chips (`thousand_skin.yaml`), with one subscriber each,
as bench-ros measures it; so are `p50_ms`, from the last byte of a frame to the subscriber's
callback, and `p50_ms_floor`. `decoder_ratio_900` is that of decoding alone, of recorded bytes
without the first frames, in which the noise is learnt, and without pauses; `decoder_ratio_idle` the
same of 1.3 %, as many as beat their hearts in a frame.

`words`: of 4,000 nodes of which 8 % speak, at several ρ; `words_wrong`: claims of these frames, of
words or silence, that are false. `hug_ms`: from the touch of all 4,000 nodes at once until every
taxel has its new value, by turns; `release_ms`: from their release until all are certain; see hug.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from benchmarks import ros, style
from benchmarks.report import QUICK, Report, be_alone, medians_s, rows_of
from benchmarks.scale import replay
from benchmarks.skip import record
from benchmarks.sparse.frames import (
    BOOKS,
    CONDITIONS,
    LOADS,
    MANY,
    SOUND,
    WORDS,
    Skin,
    Tally,
    run_all,
)
from benchmarks.sparse.hug import hug
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.framing.load import capacity


def main() -> None:
    report = Report("sparse", "Sparse codes: what is certain, and what of it is false")
    everything, sound, words = Tally(), Tally(), Tally()
    by_load: dict[tuple[int, int, int], dict[float, Tally]] = {
        book: {load: Tally() for load in LOADS} for book in BOOKS
    }
    by_condition: dict[str, Tally] = {condition: Tally() for condition in CONDITIONS}
    for job, tallies in run_all():
        for (condition, load), tally in tallies.items():
            if condition == MANY:
                words += tally
                continue
            everything += tally
            by_condition[condition] += tally
            if condition == "random" and job.rho >= 15:
                by_load[job.book][load] += tally
            if condition in SOUND and job.rho >= 15 and job.book[1] >= 64 and load <= 0.45:
                sound += tally
    with threadpool_limits(1):
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
        took = times()
        busy, idle = decoder_ratios()
    cpu_ratio, driver, floor = live()
    hugged = hug(ros.CASES[4000])
    report.table(["speak", "µs"], [[speakers, 1e6 * each] for speakers, each in took.items()])
    course = (hugged.t_s, hugged.right, hugged.certain)
    shown = (hugged.t_s > -0.1) & (hugged.t_s < 4)
    report.table(
        ["t, s", "right", "certain"],
        list(zip(*(each[shown] for each in course), strict=True)),
    )
    report.finish(
        picture(report.tables),
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


def times() -> dict[int, float]:
    """Median time of a frame by how many speak, of 4,000 nodes on 912 chips, s."""
    skin = Skin(4000, 912, 10, 100)
    spec = skin.spec
    frames = {}
    for speakers in (0, 1, 20, 100, 320, 550):
        level = np.zeros(spec.nodes, np.float32)
        level[skin.rng.permutation(spec.nodes)[:speakers]] = 1
        line = skin.chips(skin.rng.integers(1024, size=spec.nodes), level, spec)
        line += skin.rng.normal(0, np.sqrt(spec.order) / 100, line.size).astype(np.float32)
        frames[speakers] = line
    named = {str(each): partial(skin.reader.read, chips) for each, chips in frames.items()}
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
    spent = [
        [replay(*each, unmeasured=0.25) for each in recordings] for _ in range(5 if QUICK else 15)
    ]
    busy, idle, orthogonal = np.median(spent, axis=0)
    return float(busy / orthogonal), float(idle / orthogonal)


def picture(tables: list[list[list[Any]]]) -> Figure:
    """Draw which frames are certain, what reading takes, and a hug."""
    course = [table[1:] for table in tables if table[0][0] == "t, s"]
    drawing = style.sheet(700 if course else 400)
    rows = [["certain", "reading"], ["hug", "hug"]][: 2 if course else 1]
    panels: dict[str, Axes] = drawing.subplot_mosaic(rows, width_ratios=(1.4, 1))
    certain, detection = panels["certain"], panels["reading"]
    books = {tuple(row[:2]): row for row in rows_of(tables, "nodes")}
    loads = np.array([row[4:] for row in books.values()], dtype=float)
    certain.imshow(loads, cmap="Blues", vmin=0, vmax=1.25, aspect="auto")
    for y, x in np.ndindex(loads.shape):
        if 0 < loads[y, x] < 1:
            text = f"{100 * loads[y, x]:.3g}"
            certain.text(x, y, text, ha="center", va="center", color="white")
    certain.set_xticks(range(len(LOADS)), [f"{load:g}" for load in LOADS])
    certain.set_yticks(range(len(books)), [f"{nodes} on {chips}" for nodes, chips in books])
    certain.set(
        xlabel="nodes that speak / chips per bit", title="Certain frames: dark all, light none"
    )
    certain.grid(visible=False)
    speakers, us = zip(*rows_of(tables, "speak"), strict=True)
    detection.plot(speakers, us, "o-")
    detection.set(xlabel="nodes that speak, of 4,000", ylabel="µs per frame", ylim=(0, None))
    detection.set_title("Reading, 912 chips per bit")
    if course:
        t_s, right, sure = np.array(course[0], dtype=float).T
        shares = panels["hug"]
        shares.plot(t_s, 100 * right, label="present value")
        shares.plot(t_s, 100 * sure, label="certain now", lw=1)
        shares.set(ylabel="taxels, %", xlabel="s", xlim=(-0.1, 1.5))
        shares.set_title("All 4,000 touched from 0 to 1 s")
        shares.legend(loc="lower right")
    return drawing


if __name__ == "__main__":
    main()
