# SPDX-License-Identifier: Apache-2.0

"""The driver node left running in real time, as a robot does.

    lap_digitizer (process) ──pty──▶ skin_driver (process) ──DDS──▶ Listener (this process)

Meanwhile pictures are looked at and left alone, and a recorder of topics comes and goes.

    python -m torture.soak --seconds 3600
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tactile_cdma.config.skin_config import SkinConfig

from ..outcome import Outcome, Plan
from ..process_watch import Watch
from .judge import Judge
from .lap_digitizer import stretch
from .listener import Listener

NAMESPACE = f"soak_{os.getpid()}"
"""Others may run drivers on this machine, too."""
DOMAINS = 101
"""Domain ids that leave room below Linux's ephemeral ports."""
SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
QUICK_S, FULL_S = 6.0, 240.0
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 6.0, 120.0
PICTURES, RECORDER = (0.1, 0.4), (0.3, 0.6)
"""Shares of a cycle in which these guests are there."""
ALONE = 0.8
"""From this share of a cycle on they are gone for long enough to compare what is held."""
PATIENCE_S, GRACE_S = 30.0, 5.0
LOOK_S = 0.5
WARM_UP, LONGEST_WARM_UP_S = 0.5, 1800.0
"""Share of the run, but no longer, after which memory is looked at: pools fill for half an hour."""
MOST_DRIFT_S = 1e-3
"""Of stamps against true time, from the first part of the run to the last."""
PARTS = 5
LONG_S = 600.0
"""In less time slopes are but told: a page more or less is too much."""
MOST_KB_PER_H, SPREADS = 2048.0, 3.0
"""Memory that grows faster than that, by more than so many spreads of the slope, is a leak."""


def run(plan: Plan) -> Iterator[Outcome]:
    """A short soak: it takes hours to be sure."""
    yield soak(QUICK_S if plan.quick else FULL_S)


def soak(seconds: float) -> Outcome:
    """Run the driver for so long after its first frame."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % DOMAINS))
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        config, link = SkinConfig.of({}), folder / "digitizer"
        powered_s = stack.enter_context(_digitizer(link))
        judge = Judge(stretch(config), config, powered_s)
        listener = stack.enter_context(Listener(f"/{NAMESPACE}/skin"))
        log = stack.enter_context((folder / "log").open("w+"))
        parameters = {"port": str(link), "publish_voltage": True, "state_folder": str(folder)}
        driver = stack.enter_context(_process(_node("skin_driver", parameters), stderr=log))
        watch = Watch(driver.pid)
        lives = begins(listener, driver) and goes_on(
            seconds, listener, driver, judge, watch, folder
        )
        crashes, hangs = ends(driver)
        log.seek(0)
        text = log.read()
    crashes += "Traceback" in text or "internal error" in text
    reports = f"{listener.pictures} pictures, {listener.reports} reports"
    return outcome_of(seconds, judge, watch, reports, crashes, hangs + (not lives))


def begins(listener: Listener, driver: subprocess.Popen[Any]) -> bool:
    """Whether a first frame comes."""
    until_s = time.monotonic() + PATIENCE_S
    while not listener.heard and time.monotonic() < until_s and driver.poll() is None:
        time.sleep(0.05)
    return bool(listener.heard)


def goes_on(
    seconds: float,
    listener: Listener,
    driver: subprocess.Popen[Any],
    judge: Judge,
    watch: Watch,
    folder: Path,
) -> bool:
    """Let time pass while guests come and go; whether frames came all the time."""
    began_s = heard_s = time.monotonic()
    cycle_s = min(max(seconds / 4, SHORTEST_CYCLE_S), LONGEST_CYCLE_S)
    with Recorder(folder / "bag") as recorder:
        while (now_s := time.monotonic()) < began_s + seconds:
            place = (now_s - began_s) / cycle_s % 1
            listener.watches = PICTURES[0] < place < PICTURES[1]
            recorder.be_there(RECORDER[0] < place < RECORDER[1])
            watch.look(alone=place > ALONE)
            while listener.heard:
                judge.judge(*listener.heard.popleft())
                heard_s = now_s
            if now_s - heard_s > PATIENCE_S or driver.poll() is not None:
                return False
            time.sleep(LOOK_S)
    return True


def ends(driver: subprocess.Popen[Any]) -> tuple[int, int]:
    """Ask it to; whether it had ended before, or ends with a complaint; whether it does not end."""
    if driver.poll() is not None:
        return 1, 0
    driver.send_signal(signal.SIGINT)
    try:
        return int(driver.wait(PATIENCE_S) != 0), 0
    except subprocess.TimeoutExpired:
        return 0, 1


class Recorder:
    """A recorder of topics that is there or not."""

    def __init__(self, bag: Path) -> None:
        self._bag = bag
        self._process: subprocess.Popen[bytes] | None = None

    def be_there(self, wanted: bool) -> None:
        if wanted and self._process is None:
            command = [sys.executable, str(SCRIPTS / "skin_bag"), str(self._bag)]
            command += ["--node", f"/{NAMESPACE}/skin"]
            quiet = subprocess.DEVNULL
            self._process = subprocess.Popen(command, stdout=quiet, stderr=quiet)
        elif not wanted and self._process is not None:
            self._process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE_S)
            self._process.kill()
            self._process.wait()
            self._process = None
            shutil.rmtree(self._bag, ignore_errors=True)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.be_there(False)


def outcome_of(
    seconds: float, judge: Judge, watch: Watch, reports: str, crashes: int, hangs: int
) -> Outcome:
    """What came of a run. reports: what else is to be said."""
    began_s = watch.t_s[0] if watch.t_s else 0.0
    slope = watch.slope(began_s + min(WARM_UP * seconds, LONGEST_WARM_UP_S))
    long = seconds >= LONG_S
    leaks = long and slope.kb_per_h - SPREADS * slope.spread_kb_per_h > MOST_KB_PER_H
    late_ms = np.array(judge.errors_s or [np.nan]) * 1e3
    moved_s = drift(judge.errors_s)
    held = "{} threads, {} descriptors".format(*(watch.alone[-1] if watch.alone else (0, 0)))
    return Outcome(
        f"{seconds:g} s in real time, pictures and a recorder coming and going",
        times=1,
        wrong_values=judge.wrong + (abs(moved_s) > MOST_DRIFT_S),
        uncounted_losses=judge.uncounted,
        crashes=crashes + watch.more_is_held + leaks,
        hangs=hangs,
        said=f"{judge.received:,} frames heard, {judge.lost} lost and told; {watch.rss_mb:.0f} MB "
        f"{slope}, {held}; stamps late by {np.median(late_ms):.2f} ms, "
        f"p99 {np.percentile(late_ms, 99):.2f}, drift {moved_s * 1e3:+.2f}; {reports}",
        rss_slope_kb_per_h=slope.kb_per_h if long else math.nan,
    )


def drift(errors_s: ArrayLike) -> float:
    """By how much stamps moved from the first to the last part of the run, s; 0 where few came."""
    first, *_, last = np.array_split(np.asarray(errors_s, float), PARTS)
    return float(np.median(last) - np.median(first)) if first.size and last.size else 0.0


def _node(script: str, parameters: Mapping[str, object]) -> list[str]:
    namespace = f"__ns:=/{NAMESPACE}"
    command = [sys.executable, str(SCRIPTS / script), "--ros-args", "-r", namespace]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={json.dumps(value)}"]
    return command


@contextmanager
def _digitizer(link: Path) -> Iterator[float]:
    """A LapDigitizer as a process; the host time of its power-up, s."""
    command = [sys.executable, "-m", "torture.soak.lap_digitizer", str(link)]
    with _process(command, stdout=subprocess.PIPE, text=True) as process:
        yield float(process.stdout.readline())


@contextmanager
def _process(command: Sequence[str], **options: Any) -> Iterator[Any]:
    """A process that ends with the soak, whatever happens."""
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, **options) as process:
        try:
            yield process
        finally:
            process.kill()
