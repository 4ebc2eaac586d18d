# SPDX-License-Identifier: Apache-2.0

"""The driver node left running in real time, as on a robot.

    KnownDigitizer ──pty──▶ skin_driver (process) ──DDS──▶ MessageJudge

Meanwhile a subscriber of pictures and a viewer come and go.

    python -m torture.load.soak --seconds 3600
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..outcome import Outcome, Plan, Tally, summary
from ..process_watch import Watch
from .loaded_skin import SKIN_DRIVER, SOAKED, LoadedSkin

QUICK_S, FULL_S = 6.0, 240.0
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 6.0, 120.0
PICTURES, VIEWER = (0.1, 0.4), (0.3, 0.6)
"""Shares of a cycle in which these guests are there."""
ALONE = 0.8
"""Share of a cycle after which both guests are gone, and threads and descriptors are compared."""
PATIENCE_S, GRACE_S = 30.0, 5.0
LOOK_S = 0.5
WARM_UP, LONGEST_WARM_UP_S = 0.5, 1800.0
"""Share of the run, but no longer, after which memory is looked at: pools fill for half an hour."""
MOST_DRIFT_S = 1e-3
"""Largest drift of stamps against the true time, from the second part of the run to the last."""
PARTS = 5
"""Parts of a run; while it starts, a busy computer makes all stamps late, which nobody can know."""
PROMPT = 10
"""Percentage of a part's stamps that is compared, the earliest: a busy computer makes the others
late, but drift moves them all."""
LONG_S = 600.0
"""Slopes of shorter runs are reported, not judged: single pages dominate them."""
MOST_KB_PER_H, SPREADS = 2048.0, 3.0
"""A leak is memory that grows faster than this, by more than so many spreads of the slope."""


def run(plan: Plan) -> Iterator[Outcome]:
    """A short soak; only hours prove much."""
    yield soak(QUICK_S if plan.quick else FULL_S, plan.seed)


def soak(seconds: float, seed: int = 1) -> Outcome:
    """Run the driver for this time after its first frame."""
    with (
        TemporaryDirectory(prefix="soak-") as folder,
        LoadedSkin(Path(folder), seed, PATIENCE_S, setting=SOAKED) as skin,
    ):
        watch = Watch(skin.process.pid)
        if skin.streams_on(1):
            goes_on(seconds, skin, watch)
        crashes, hangs = ends(skin.process, PATIENCE_S)
        reports = f"{skin.pictures} pictures, {skin.reports} reports"
        crashes, hangs = crashes + skin.defects(), hangs + skin.hangs
        return outcome_of(seconds, skin.judge.tally, watch, reports, crashes, hangs)


def goes_on(seconds: float, skin: LoadedSkin, watch: Watch) -> None:
    """Let time pass while guests come and go, until it is over or no frame comes."""
    cycle_s = min(max(seconds / 4, SHORTEST_CYCLE_S), LONGEST_CYCLE_S)
    began_s = time.monotonic()
    with Viewer(skin) as viewer:
        while (now_s := time.monotonic()) < began_s + seconds and skin.streams_on(1):
            place = (now_s - began_s) / cycle_s % 1
            skin.watches = PICTURES[0] < place < PICTURES[1]
            viewer.be_there(VIEWER[0] < place < VIEWER[1])
            watch.look(alone=place > ALONE)
            time.sleep(LOOK_S)


class Viewer:
    """A viewer in a terminal that is there or not."""

    def __init__(self, skin: LoadedSkin) -> None:
        self._skin = skin
        self._process: subprocess.Popen[bytes] | None = None

    def be_there(self, wanted: bool) -> None:
        """Start or end it if necessary."""
        if wanted and self._process is None:
            view = [sys.executable, str(SKIN_DRIVER.with_name("skin_view")), "--seconds", "3600"]
            self._process = subprocess.Popen(
                [*view, "--topic", f"{self._skin.name}/tactile"],
                env=self._skin.environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        elif not wanted and self._process is not None:
            self._process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE_S)
            self._process.kill()
            self._process.wait()
            self._process = None

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.be_there(False)


def ends(driver: subprocess.Popen[Any], patience_s: float) -> tuple[int, int]:
    """Interrupt it; (crashes, hangs): had it ended before or fails now, or does it not end."""
    if driver.poll() is not None:
        return 1, 0
    driver.send_signal(signal.SIGINT)
    try:
        return int(driver.wait(patience_s) != 0), 0
    except subprocess.TimeoutExpired:
        return 0, 1


def outcome_of(
    seconds: float, tally: Tally, watch: Watch, reports: str, crashes: int, hangs: int
) -> Outcome:
    """The row of a run. reports: what else is to be said."""
    began_s = watch.t_s[0] if watch.t_s else 0.0
    slope = watch.slope(began_s + min(WARM_UP * seconds, LONGEST_WARM_UP_S))
    long = seconds >= LONG_S
    leaks = long and slope.kb_per_h - SPREADS * slope.spread_kb_per_h > MOST_KB_PER_H
    late_ms = np.array(tally.stamp_errors_s or [np.nan]) * 1e3
    moved_s = drift(tally.stamp_errors_s)
    held = "{} threads, {} descriptors".format(*(watch.alone[-1] if watch.alone else (0, 0)))
    return Outcome(
        f"{seconds:g} s in real time, pictures and a viewer coming and going",
        times=1,
        wrong_values=tally.wrong_values + (abs(moved_s) > MOST_DRIFT_S),
        uncounted_losses=tally.uncounted_losses,
        crashes=crashes + watch.more_is_held + leaks,
        hangs=hangs,
        said=f"{tally.frames:,} frames heard, {tally.lost} lost and told; {watch.rss_mb:.0f} MB "
        f"{slope}, {held}; stamps late by {np.median(late_ms):.2f} ms, "
        f"p99 {np.percentile(late_ms, 99):.2f}, drift {moved_s * 1e3:+.2f}; {reports}",
        rss_slope_kb_per_h=slope.kb_per_h if long else None,
    )


def drift(errors_s: ArrayLike) -> float:
    """By how much stamps moved from the second to the last part of the run, s; 0 where few came."""
    _, begin, *_, end = np.array_split(np.asarray(errors_s, float), PARTS)
    if not (begin.size and end.size):
        return 0.0
    return float(np.percentile(end, PROMPT) - np.percentile(begin, PROMPT))


def main() -> int:
    """A soak of any length, `make soak`; 1 if anything happened that must not happen."""
    parser = argparse.ArgumentParser(prog="python -m torture.load.soak", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    outcome = soak(parser.parse_args().seconds)
    print(outcome.said)
    print(summary([outcome]))
    return int(not outcome.good)


if __name__ == "__main__":
    sys.exit(main())
