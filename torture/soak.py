# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The driver node left running in real time, as a robot does: is it right, and does it grow?

    lap_digitizer (process) ──pty──▶ skin_driver (process) ──DDS──▶ Listener (this process)

Meanwhile pictures are looked at and left alone, and a recorder of topics comes and goes.

    python -m torture.soak --seconds 3600
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.skin_config import SkinConfig

from .lap_digitizer import stretch
from .outcome import Outcome, Plan, summary
from .process_watch import Watch
from .soak_listener import Judge, Listener

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts"
QUICK_S, FULL_S = 6.0, 240.0
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 6.0, 120.0
PICTURES, RECORDER = (0.1, 0.4), (0.3, 0.6)
"""Shares of a cycle in which they are there; what is held then is compared when they are not."""
REST = 0.8
"""From this share of a cycle on neither is there for long enough."""
PATIENCE_S = 30.0
LOOK_S = 0.5
WARM_UP = 0.25
"""Share of the run after which memory is looked at, 5 min at most: pools fill up at first."""
LONGEST_WARM_UP_S = 300.0
DRIFT_S = 1e-3
"""Most that stamps may have moved against true time from the first part of the run to the last."""
PARTS = 5
"""Of the run: of the first and the last, the medians of stamps are compared."""


def run(plan: Plan) -> Iterator[Outcome]:
    """A short soak: it takes hours to be sure."""
    yield soak(QUICK_S if plan.quick else FULL_S)


def main() -> int:
    """A soak of any length; 1 if anything happened that must not happen."""
    parser = argparse.ArgumentParser(prog="python -m torture.soak", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    outcome = soak(parser.parse_args().seconds)
    print(outcome.said)
    print(summary([outcome]))
    return int(not outcome.good)


@dataclass
class Skin:
    """The processes of a soak, and what is known of them."""

    folder: Path
    digitizer: subprocess.Popen[str]
    driver: subprocess.Popen[bytes]
    judge: Judge
    watch: Watch


def soak(seconds: float) -> Outcome:
    """Run the driver for so long after its first frame."""
    config = SkinConfig.of({})
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        listener = stack.enter_context(Listener())
        link = folder / "digitizer"
        command = [sys.executable, "-m", "torture.lap_digitizer", str(link)]
        digitizer = stack.enter_context(_process(command, stdout=subprocess.PIPE, text=True))
        told = stretch(config)
        assert digitizer.stdout is not None
        judge = Judge(told, config, float(digitizer.stdout.readline()))
        log = stack.enter_context((folder / "log").open("wb"))
        parameters = {"port": str(link), "publish_voltage": True, "state_folder": str(folder)}
        driver = stack.enter_context(_process(_node("skin_driver", parameters), stderr=log))
        skin = Skin(folder, digitizer, driver, judge, Watch(driver.pid))
        lives = _begins(listener, driver) and _live(skin, listener, seconds)
        crashes = int(driver.poll() is not None)
        driver.send_signal(signal.SIGINT)
        try:
            crashes += not crashes and driver.wait(PATIENCE_S) != 0
            hangs = 0
        except subprocess.TimeoutExpired:
            hangs = 1
        text = (folder / "log").read_text()
        crashes += "Traceback" in text or "internal error" in text
    return _outcome(skin, listener, seconds, crashes, hangs + (not lives))


def _begins(listener: Listener, driver: subprocess.Popen[bytes]) -> bool:
    """Whether a frame comes."""
    until_s = time.monotonic() + PATIENCE_S
    while not listener.heard and time.monotonic() < until_s and driver.poll() is None:
        time.sleep(0.05)
    return bool(listener.heard)


def _live(skin: Skin, listener: Listener, seconds: float) -> bool:
    """Let time pass while guests come and go; whether frames came all the time."""
    began_s = heard_s = time.monotonic()
    cycle_s = min(max(seconds / 4, SHORTEST_CYCLE_S), LONGEST_CYCLE_S)
    with _Recorder(skin.folder) as recorder:
        while (now_s := time.monotonic()) < began_s + seconds:
            place = (now_s - began_s) / cycle_s % 1
            listener.watch_pictures(PICTURES[0] < place < PICTURES[1])
            recorder.be_there(RECORDER[0] < place < RECORDER[1])
            skin.watch.look(alone=place > REST)
            while listener.heard:
                skin.judge.judge(listener.heard.popleft())
                heard_s = now_s
            if now_s - heard_s > PATIENCE_S or skin.driver.poll() is not None:
                return False
            time.sleep(LOOK_S)
    return True


class _Recorder:
    """A recorder of topics that is there or not."""

    def __init__(self, folder: Path) -> None:
        self._bag = folder / "bag"
        self._process: subprocess.Popen[bytes] | None = None

    def be_there(self, wanted: bool) -> None:
        if wanted and self._process is None:
            command = [sys.executable, str(SCRIPTS / "skin_bag"), str(self._bag)]
            self._process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
        elif not wanted and self._process is not None:
            self._process.send_signal(signal.SIGINT)
            self._process.wait(PATIENCE_S)
            self._process = None
            shutil.rmtree(self._bag, ignore_errors=True)

    def __enter__(self) -> _Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.be_there(False)


def _outcome(skin: Skin, listener: Listener, seconds: float, crashes: int, hangs: int) -> Outcome:
    judge, watch = skin.judge, skin.watch
    drift_s, median_s, p99_s = _stamps(np.array(judge.errors_s))
    warm_s = min(WARM_UP * seconds, LONGEST_WARM_UP_S)
    slope = watch.slope(watch.t_s[0] + warm_s)
    held = watch.alone
    grown = len(held) > 1 and any(now > then for now, then in zip(held[-1], held[0], strict=True))
    said = (
        f"{judge.received} of {judge.received + judge.lost} frames heard, "
        f"RSS {watch.rss_kb[-1] / 1024:.0f} MB {slope}, {held} threads and descriptors, "
        f"stamps late by {median_s * 1e3:.2f} ms, p99 {p99_s * 1e3:.2f} ms, "
        f"moved by {drift_s * 1e3:.3f} ms; {listener.pictures} pictures, {listener.reports} reports; {dict(listener.complaints)}"
    )
    return Outcome(
        f"{seconds:.0f} s in real time, guests coming and going",
        times=1,
        wrong_values=judge.wrong + (abs(drift_s) > DRIFT_S),
        uncounted_losses=judge.uncounted,
        crashes=crashes + grown,
        hangs=hangs,
        said=said,
        rss_slope_kb_per_h=slope.kb_per_h,
    )


def _stamps(late_s: NDArray[np.float64]) -> tuple[float, float, float]:
    """By how much stamps moved from the first to the last part of the run, their median and p99."""
    first, *_, last = np.array_split(late_s, PARTS)
    drift_s = float(np.median(last) - np.median(first))
    return drift_s, float(np.median(late_s)), float(np.percentile(np.abs(late_s), 99))


def _node(script: str, parameters: Mapping[str, object]) -> list[str]:
    command = [sys.executable, str(SCRIPTS / script), "--ros-args"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={json.dumps(value)}"]
    return command


@contextmanager
def _process(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """A process that ends with the soak, whatever happens."""
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, **options) as process:
        try:
            yield process
        finally:
            process.kill()


if __name__ == "__main__":
    sys.exit(main())
