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

"""A virtual digitizer, a man in the middle, a real tty and a driver, all running."""

from __future__ import annotations

import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from tactile_cdma.driver import Driver
from tactile_cdma.parameters import Values
from tactile_cdma.pipeline import TactileFrame
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.pty import serve
from tactile_cdma.skin_config import SkinConfig

from .line_judge import Judge
from .man_in_the_middle import ManInTheMiddle, Schedule
from .renumbered import Counted

BAUD = 115_200
"""A tty has to be given one; a pseudo-terminal takes all at once."""
LOOK_S = 2e-3


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """A kind of stream. parameters: of the driver. options: of the simulator."""

    name: str
    parameters: Values = field(default_factory=dict)
    options: dict[str, object] = field(default_factory=dict)
    begin: Counted | None = None


class Rig:
    """Everything that it takes for bytes to come to harm on a real tty; a context manager."""

    def __init__(self, stream: Stream, seed: int, patience_s: float) -> None:
        """patience_s: without any progress for so long it hangs."""
        self._patience_s = patience_s
        self.config = SkinConfig.of({"drift_pa_per_min": 0.0, **stream.parameters})
        options = SimOptions(**{"seed": seed, "speed": 0.0, **stream.options})  # type: ignore[arg-type]
        self._digitizer = VirtualDigitizer(options)
        self.man = ManInTheMiddle(self._digitizer, stream.begin)
        self.frames: list[TactileFrame] = []
        self.problems: list[str] = []
        self._first_index = stream.begin.first_index if stream.begin else 0
        self._judge: Judge | None = None
        self._started = 0
        self._stop, self._ready = threading.Event(), threading.Event()
        self._path = Path()
        self._line = threading.Thread(target=self._carry, daemon=True)

    def __enter__(self) -> Rig:
        self._line.start()
        self._ready.wait(self._patience_s)
        self.driver = Driver(
            self.config, str(self._path), BAUD, self.frames.append, self._on_problem
        )
        self.driver.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.driver.stop()
        self._stop.set()
        self._line.join()

    def run(self, schedule: Schedule) -> Counter[str]:
        """Put a schedule through; what was wrong then, with its `crashes` and `hangs`."""
        self.problems.clear()
        self.man.begin(schedule)
        found: Counter[str] = Counter()
        progress, since = -1, time.monotonic()
        while not self._consumed():
            time.sleep(LOOK_S)
            if progress != (progress := self.driver.pipeline.packet_counts["bytes"]):
                since = time.monotonic()
            elif time.monotonic() - since > self._patience_s or not self._line.is_alive():
                found["hangs"] += 1
                break
        with self.driver.between_frames() as pipeline:
            frames, self.frames[:] = list(self.frames), []
            found += self._judged().look(frames, pipeline)
        found["crashes"] += not self._line.is_alive()
        found["crashes"] += sum("internal error" in problem for problem in self.problems)
        return found

    def _consumed(self) -> bool:
        """Whether the driver has dealt with everything that was handed on to it."""
        if not self.man.over():
            return False
        with self.driver.between_frames() as pipeline:
            return pipeline.packet_counts["bytes"] >= self.man.ledger.counts.bytes

    def _judged(self) -> Judge:
        """The judge, who knows of all streams that began."""
        if self._judge is None:
            self._judge = Judge(self.config, self.man.ledger, self.man.frame_samples)
        for started_s in self.man.starts[self._started :]:
            self._judge.began(
                self._digitizer.options, self._digitizer.setup, started_s, self._first_index
            )
        self._started = len(self.man.starts)
        return self._judge

    def _carry(self) -> None:
        serve(lambda: self.man, None, self._stop, self._on_ready)

    def _on_ready(self, path: Path) -> None:
        self._path = path
        self._ready.set()

    def _on_problem(self, problem: str | None) -> None:
        if problem:
            self.problems.append(problem)
