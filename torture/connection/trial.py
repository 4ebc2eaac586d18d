# SPDX-License-Identifier: Apache-2.0

"""One driver under one kind of fault; many trials take turns in one thread."""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import TypeAlias

import numpy as np

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.sim.options import SimOptions

from ..outcome import Outcome, Plan, Tally
from .judge import ConnectionJudge, Digitizer
from .plug import Plug

BAUD = 2_000_000
ROUND_S = 5e-4
"""Pause after a round of turns, s."""
TURN_S = 0.1
"""Most time that a turn counts for, s: this process may have had to wait."""
SOON_S = 1.0
"""Limit of the median time until frames come, s: a driver that notices nothing asks after 1 s."""
ENOUGH = 20
"""Fewest cases for that limit: fewer may all have come at a bad moment."""
SCENES = ("moving", "press", "all")
Rng: TypeAlias = np.random.Generator
Turns: TypeAlias = Generator[None, None, None]


class HangError(Exception):
    """Something did not happen in time."""


class Trial:
    """One driver, whose port is a plug, and the result of the faults put in.

    tally: faults so far, and what was found. said: for the table. hold_s: how long the consumer of
    the next frame takes. limit_s: time to wait for anything before it counts as a hang.
    resumed_s: times from port and digitizer being there to a published frame.
    """

    def __init__(
        self,
        fault: str,
        plan: Plan,
        plug: Plug,
        faults: Callable[[Trial], Turns],
        parameters: Mapping[str, object] | None = None,
    ) -> None:
        """fault: for the table. faults: put them in, in turns. parameters: of the driver."""
        self.fault, self.plug, self._faults = fault, plug, faults
        self.said = ""
        self.hold_s = 0.0
        self.resumed_s: list[float] = []
        self.judge = ConnectionJudge()
        self.tally = self.judge.tally
        self.limit_s = 10.0 if plan.quick else 30.0
        config = SkinConfig.of(dict(parameters or {}))
        self.driver = Driver(config, plug.url, BAUD, self._consume, self._note)

    def run(self) -> Turns:
        """Start the driver, put the faults in, and stop it, whatever the port is doing then."""
        self.driver.start()
        try:
            yield from self._faults(self)
            self.judge.settle()
            lost_frames = self.driver.pipeline.counters.lost_frames
            self.tally.uncounted_losses += self.judge.account(lost_frames)
            self.tally.crashes += not self._lives
            yield from self.stops()
        except HangError:
            self.tally.hangs += 1
            self.tally.crashes += not self._lives
            self.said = f"{self.plug.url} hangs at {self.tally.times}: {self.driver.problem}"
        finally:
            self.plug.unplug()
            self.driver.stop()

    def outcome(self) -> Outcome:
        """The row of this trial alone."""
        return together([self])

    @property
    def late(self) -> int:
        """How often frames were published too late."""
        return self.judge.late + self._is_late

    def digitizer(self, options: SimOptions) -> Digitizer:
        """A digitizer that is powered up now and known to the judge."""
        return Digitizer(options, lambda: self.plug.now_s, self.judge)

    def until(self, condition: Callable[[], object], least_s: float = 0.0) -> Turns:
        """Take turns until a condition holds. Raises HangError if it takes too long.

        least_s: how long it takes if nothing is wrong.
        """
        left_s, now_s = 10 * least_s + self.limit_s, time.monotonic()
        while not condition():
            before_s, now_s = now_s, time.monotonic()
            left_s -= min(now_s - before_s, TURN_S)
            if left_s < 0:
                raise HangError
            self.plug.step()
            yield

    def after(self, seconds: float) -> Turns:
        """Take turns for this time."""
        end_s = time.monotonic() + seconds
        yield from self.until(lambda: time.monotonic() >= end_s, seconds)

    def stall(self, seconds: float) -> Turns:
        """Take turns for this much of the digitizer's time."""
        end_s = self.plug.now_s + seconds
        yield from self.until(lambda: self.plug.now_s >= end_s, seconds)

    def told(self, *texts: str) -> Turns:
        """Take turns until the driver reports a problem with one of these texts."""
        yield from self.until(lambda: any(text in (self.driver.problem or "") for text in texts))

    def resumes(self) -> Turns:
        """Take turns until frames are published again, and no problem is reported."""
        begin_s = time.monotonic()
        yield from self.until(self._flows)
        self.resumed_s.append(time.monotonic() - begin_s)

    def stops(self) -> Turns:
        """Take turns until the driver has stopped."""
        stopping = threading.Thread(target=self.driver.stop, daemon=True)
        stopping.start()
        yield from self.until(lambda: not stopping.is_alive())

    def counted(self, count: Callable[[], int], true: Callable[[], int]) -> Turns:
        """Take turns until a count is the true one; the difference is uncounted losses."""
        try:
            yield from self.until(lambda: count() == true())
        except HangError:
            self.tally.uncounted_losses += abs(count() - true())

    def caught_up(self) -> Turns:
        """Take turns until a frame is published that was not sent yet."""
        digitizer = self.plug.device
        assert isinstance(digitizer, Digitizer)
        now_s = digitizer.now_s
        yield from self.until(lambda: self.judge.reached(digitizer, now_s))

    def _flows(self) -> bool:
        return self.judge.hears(self.plug.device) and self.driver.problem is None

    @property
    def took(self) -> str:
        """The times until frames came, for the table."""
        took_ms = [1e3 * seconds for seconds in self.resumed_s]
        missing = max(self.judge.missing, default=0)
        return (
            f"frames after {statistics.median(took_ms):.0f} ms (at most {max(took_ms):.0f}), "
            f"{missing} missing at most"
        )

    @property
    def _is_late(self) -> bool:
        return len(self.resumed_s) >= ENOUGH and statistics.median(self.resumed_s) > SOON_S

    @property
    def _lives(self) -> bool:
        return any(thread.name == f"skin {self.plug.url}" for thread in threading.enumerate())

    def _consume(self, frame: TactileFrame) -> None:
        self.judge.take(frame, self.driver.connections)
        if self.hold_s:
            hold_s, self.hold_s = self.hold_s, 0.0
            time.sleep(hold_s)

    def _note(self, problem: str | None) -> None:
        self.tally.crashes += problem is not None and problem.startswith("internal error")


def rng_of(plan: Plan, *place: int) -> Rng:
    """The random generator of one kind of fault."""
    return np.random.default_rng([plan.seed, *place])


def some_skin(rng: Rng) -> SimOptions:
    """A skin that is touched, another one each time."""
    return SimOptions(seed=int(rng.integers(1 << 31)), scene=str(rng.choice(SCENES)))


def side_by_side(trials: Iterable[Turns], at_once: int = 5) -> None:
    """Run trials, at_once of them in turns, until all are over."""
    waiting = iter(trials)
    running = list(islice(waiting, at_once))
    while running:
        running = [trial for trial in running if next(trial, _OVER) is not _OVER]
        running += islice(waiting, at_once - len(running))
        time.sleep(ROUND_S)


_OVER = object()


def outcomes(trials: Sequence[Trial]) -> Iterator[Outcome]:
    """Run these trials; a row for every kind of fault."""
    side_by_side(trial.run() for trial in trials)
    for fault in dict.fromkeys(trial.fault for trial in trials):
        yield together([trial for trial in trials if trial.fault == fault])


def together(trials: Sequence[Trial]) -> Outcome:
    """The row of trials of one kind of fault."""
    total, said = Tally(), trials[0].said
    for trial in trials:
        found = replace(trial.tally, hangs=trial.tally.hangs + trial.late)
        total += found
        if not found.outcome("").good:
            said = trial.said
    return total.outcome(trials[0].fault, said)
