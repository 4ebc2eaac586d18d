# SPDX-License-Identifier: Apache-2.0

"""A virtual digitizer, a man in the middle, a real tty and a driver, all running."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tactile_cdma.config.parameters import Values
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.stream import Event
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.pty import serve

from ..outcome import Tally
from .damage import LOST
from .judge import LineJudge
from .man_in_the_middle import Counted, ManInTheMiddle, Schedule

BAUD = 115_200
"""A tty has to be given one; a pseudo-terminal takes all at once."""
LOOK_S = 2e-3


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """A kind of stream. parameters: the driver's. options: the simulator's. begin: counters."""

    name: str
    parameters: Values = field(default_factory=dict)
    options: Mapping[str, object] = field(default_factory=dict)
    begin: Counted | None = None


class Rig:
    """Digitizer, man in the middle, tty and driver. Use as a context manager."""

    def __init__(
        self,
        stream: Stream,
        seed: int,
        patience_s: float,
        spoil: Callable[[bytes], bytes] | None = None,
    ) -> None:
        """patience_s: time without progress that counts as a hang. spoil: see ManInTheMiddle."""
        self._patience_s = patience_s
        self.config = SkinConfig.of({"drift_pa_per_min": 0.0, **stream.parameters})
        given = {"scene": "moving", "seed": seed, "speed": 0.0, **stream.options}
        options = SimOptions(**given)  # type: ignore[arg-type]
        # At speed 0 device time passes with the samples; the host's clock must not trigger reports.
        self._digitizer = VirtualDigitizer(options, clock=lambda: 0.0)
        self.man = ManInTheMiddle(self._digitizer, stream.begin, spoil)
        self.frames: list[TactileFrame] = []
        self.problems: list[str] = []
        self._first_index = stream.begin.first_index if stream.begin else 0
        self._judge: LineJudge | None = None
        self._started = 0
        self._through = 0  # bytes of which the driver has taken in all that they held
        self._stop, self._ready = threading.Event(), threading.Event()
        self._path = Path()
        self._line = threading.Thread(target=self._carry, daemon=True)

    def __enter__(self) -> Rig:
        self._line.start()
        self._ready.wait(self._patience_s)
        self.driver = Driver(
            self.config, str(self._path), BAUD, self.frames.append, self._on_problem
        )
        self._follow(self.driver.pipeline)
        self.driver.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.stop()
        self._stop.set()
        self._line.join()

    def _follow(self, pipeline: Pipeline) -> None:
        """Note how far the driver is. Bytes are counted before their frames are decoded."""
        take = pipeline.take

        def followed(event: Event) -> TactileFrame | None:
            frame = take(event)
            if event.needs_bytes:
                self._through = pipeline.packet_counts.bytes
            return frame

        pipeline.take = followed  # type: ignore[method-assign]

    def run(self, schedule: Schedule) -> Tally:
        """Run a schedule; returns what was wrong."""
        self.man.begin(schedule)
        hangs = not self._wait(self._consumed)
        with self.driver.between_frames() as pipeline:
            found = self._judged().look(self._taken(), pipeline)
        # A driver reports a defect later than others can see its effect, but before it reads on.
        self.man.begin(Schedule(LOST, 0, schedule.rng))
        found.hangs += hangs + (not self._wait(self._consumed))
        found.crashes += self._crashes()
        return found

    def receive(self, frames: int, rng: np.random.Generator) -> Tally:
        """Let bytes pass until this many frames came; returns what was wrong with them."""

        def come() -> bool:
            if self.man.over():
                self.man.begin(Schedule(LOST, 0, rng))
            return len(self.frames) >= frames

        hangs = not self._wait(come)
        with self.driver.between_frames():
            found = self._judged().look_at_frames(self._taken())
        found.hangs += hangs
        found.crashes += self._crashes()
        return found

    def _wait(self, happened: Callable[[], bool]) -> bool:
        """Wait for a condition; False if the line stands still for patience_s before."""
        deadline_s, progress = 0.0, -1
        while not happened():
            time.sleep(LOOK_S)
            if progress != (progress := self.driver.pipeline.counters.samples):
                deadline_s = time.monotonic() + self._patience_s
            elif time.monotonic() > deadline_s or not self._line.is_alive():
                return False
        return True

    def _consumed(self) -> bool:
        """Whether the driver has processed all bytes handed to it."""
        if not self.man.over():
            return False
        with self.driver.between_frames():
            return self._through >= self.man.ledger.counts.bytes

    def _taken(self) -> list[TactileFrame]:
        """The frames published since the last call."""
        frames, self.frames[:] = list(self.frames), []
        return frames

    def _judged(self) -> LineJudge:
        """The judge, up to date with all STARTs."""
        if self._judge is None:
            self._judge = LineJudge(self.config, self.man.ledger, self.man.frame_samples)
        for started in self.man.starts[self._started :]:
            self._judge.began(self._digitizer.options, started, self._first_index)
        self._started = len(self.man.starts)
        return self._judge

    def _crashes(self) -> int:
        """Number of defects that ended a thread, or would have."""
        crashes = sum("internal error" in problem for problem in self.problems)
        self.problems.clear()
        return crashes + (not self._line.is_alive())

    def _carry(self) -> None:
        serve(lambda: self.man, None, self._stop, self._on_ready)

    def _on_ready(self, path: Path) -> None:
        self._path = path
        self._ready.set()

    def _on_problem(self, problem: str | None) -> None:
        if problem:
            self.problems.append(problem)
