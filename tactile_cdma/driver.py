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

"""A running skin: port, handshake and decoding in one thread, reconnecting by itself."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType

from ._protocol import SyncMode
from .backlog import Backlog
from .errors import PortError, RecordingEndError
from .messages import (
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    Packet,
    RollCall,
    Start,
    Stop,
)
from .parameters import GAP, REPLAY
from .pipeline import Pipeline, TactileFrame
from .protocol import PacketWriter, diagnose
from .silence import quiet_uv
from .skin_config import SkinConfig
from .source import Port
from .stuck import StuckNodes
from .vitals import Vitals

PATIENCE_S = 1.0
"""A digitizer that says nothing useful for so long is asked again."""
CONNECT_S = 0.5
"""Longer than a port in order takes to open."""
RETRY_S = (0.2, 0.5, 1.0, 2.0)
"""Pauses between attempts to open a port; the last one repeats."""
LOOK_S = 0.05
"""How much waits in the port is looked at so often, for that takes 10 µs."""
MOST_CALLS = 3
"""Roll calls in a row that may come to nothing."""
WAITING = "waiting for the first frame"
"""What keeps frames from coming right after a port was opened."""


class Driver:
    """Runs one skin in a thread of its own until stopped.

    on_frame is called in that thread for every frame; on_problem with one sentence whenever the
    reason for not receiving frames changes, and with None when frames flow again.

    url: of the port. vitals: how the thread does. stuck: which nodes do not move.
    """

    def __init__(
        self,
        config: SkinConfig,
        url: str,
        baud: int,
        on_frame: Callable[[TactileFrame], None],
        on_problem: Callable[[str | None], None],
    ) -> None:
        self.pipeline = Pipeline(config)
        self.problem: str | None = None
        self.connections = 0
        self.vitals = Vitals()
        self.stuck = StuckNodes(config.layout)
        self._first_port: Port | None = None
        self.url, self._baud = url, baud
        self._on_frame, self._on_problem = on_frame, on_problem
        self._stop = threading.Event()
        self._opening = False
        self._busy = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=f"skin {url}", daemon=True)

    def start(self, port: Port | None = None) -> None:
        """Begin to stream, on an already open port if one is given (the driver closes it)."""
        self._first_port = port
        self._thread.start()

    def stop(self) -> None:
        """Stop the digitizer, close the port, join the thread; nothing is called from now on.

        A thread that is just connecting to a host that does not answer is not waited for: it ends
        by itself when that fails.
        """
        self._stop.set()
        while self._thread.is_alive():
            self._thread.join(CONNECT_S)
            if self._opening:
                return

    @contextmanager
    def between_frames(self) -> Iterator[Pipeline]:
        """The pipeline while no frame is decoded or handed on, for calls from other threads.

        Bytes wait in the port meanwhile, so nothing is lost if this is short.
        """
        with self._busy:
            yield self.pipeline

    def __enter__(self) -> Driver:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _run(self) -> None:
        attempt = 0
        while not self._stop.is_set():
            try:
                with self._open() as port:
                    if self._stop.is_set():
                        return
                    attempt = 0
                    self.connections += 1
                    self._stream(port)
            except RecordingEndError as end:
                self._report(str(end))
                return
            except PortError as error:
                self._report(str(error))
            except Exception:  # a defect of ours must neither go unseen nor end the skin for good
                self._report(f"internal error, starting again: {traceback.format_exc()}")
            else:
                continue
            self._stop.wait(RETRY_S[min(attempt, len(RETRY_S) - 1)])
            attempt += 1

    def _open(self) -> Port:
        """The port given at the start, or the port anew; raises PortError."""
        first, self._first_port = self._first_port, None
        if first is not None:
            return first
        self._opening = True
        try:
            return Port(self.url, self._baud)
        finally:
            self._opening = False

    def _stream(self, port: Port) -> None:
        """Handshake, then decode until stopped; raises PortError when the port is lost."""
        pipeline = self.pipeline
        session = Session(pipeline.config)
        with self._busy:
            pipeline.reconnected()
        if not self.problem:
            self._report(WAITING)
        port.write(session.open())
        backlog = Backlog(pipeline.config.spec.frame_period_s)
        is_recording = self.url.startswith(REPLAY)  # of which nothing is left out
        look_s, age_s = -math.inf, 0.0
        try:
            while not self._stop.is_set():
                data, t_host = port.read()
                with self._busy:
                    frames = pipeline.feed(data, t_host)
                    t_decoded = time.monotonic()
                    for frame in frames:
                        self._on_frame(frame)
                        self.vitals.handed_on(frame, t_host, t_decoded)
                        contact_pa = pipeline.config.rest.contact_pa
                        self.stuck.look(frame.readings, frame.t_middle, contact_pa)
                age_s = t_host - frames[-1].t_host if frames else age_s
                if t_host >= look_s:
                    waiting_bytes = port.waiting
                    self.vitals.dealt_with(waiting_bytes)
                    look_s = t_host + LOOK_S
                    if backlog.is_hopeless(waiting_bytes, age_s, t_host) and not is_recording:
                        with self._busy:
                            pipeline.skipped(port.skip())
                if frames and self.problem:
                    self._report(None)
                if request := session.watch(pipeline, t_host):
                    port.write(request)
                    if session.problem:
                        self._report(session.problem)
        finally:
            pipeline.close()
            if self._stop.is_set():
                port.write(session.close())

    def _report(self, problem: str | None) -> None:
        if problem != self.problem and not self._stop.is_set():
            self.problem = problem
            self._on_problem(problem)


class Session:
    """The host's side of the start-up handshake: what to send, and what is wrong if nothing comes.

    Where a certain digitizer is asked for, no other one is configured or started. No I/O: bytes to
    send are returned.
    """

    def __init__(self, config: SkinConfig | None = None) -> None:
        """config: how the digitizer is to be set; None leaves it as it is."""
        self.problem: str | None = None
        self._writer = PacketWriter()
        self._setting: tuple[Configure, ...] = ()
        self._config = config
        self._ours = config is None or config.digitizer_id is None
        self._calls_roll = config is not None and config.roll_call
        self._calls_left, self._next_call_s = MOST_CALLS, -math.inf
        if config is not None:
            layout = FrameLayout.of(config.spec, config.samples_per_chip)
            integrated = config.samples_per_chip == 1
            if config.timing == GAP:
                self._setting = (Configure(layout, SyncMode.NONE, integrated),)
            else:
                quiet = quiet_uv(config.spec)
                self._setting = (Configure(layout, SyncMode.DRIVE, integrated, quiet),)
        self._frames = -1
        self._restarts = self._bytes = 0
        self._deadline = -math.inf

    def open(self) -> bytes:
        """Configure (where asked to) and start the digitizer; where it counts, ask who it is."""
        start = (*self._setting, GetInfo(), Start()) if self._ours else (GetInfo(),)
        return self._requests(*start)

    def close(self) -> bytes:
        """Stop the digitizer, if it was started."""
        return self._requests(Stop()) if self._ours else b""

    def introduced(self, info: Info) -> bytes:
        """What to send now that the digitizer has said who it is."""
        known = self._ours
        wrong = self._config.refusal(info.digitizer_id) if self._config is not None else None
        self._ours = wrong is None
        return self.open() if self._ours and not known else b""

    def watch(self, pipeline: Pipeline, now_s: float) -> bytes:
        """Requests that are due: nothing came of the last ones, or it is now known who is there."""
        if pipeline.info is not None and (start := self.introduced(pipeline.info)):
            self._deadline = self._due_s(pipeline, now_s)
            return start
        if self._calls_roll and (request := self._roll_call(pipeline, now_s)):
            return request
        stuck = pipeline.counters.frames == self._frames
        if stuck and now_s < self._deadline:
            return b""
        if stuck:
            self.problem = self._why(pipeline)
        self._frames, self._restarts = pipeline.counters.frames, pipeline.counters.restarts
        self._bytes = pipeline.parser.counters.bytes
        self._deadline = self._due_s(pipeline, now_s)
        return self.open() if stuck else b""

    def _due_s(self, pipeline: Pipeline, now_s: float) -> float:
        """When frames must have come of a request that is sent now."""
        return now_s + max(PATIENCE_S, 3 * pipeline.config.spec.frame_period_s)

    def _roll_call(self, pipeline: Pipeline, now_s: float) -> bytes:
        """The request for a roll call, if there has been none in which all nodes were heard.

        The digitizer may have been reset, or the clocks have changed: then it is time for another.
        """
        clocks = pipeline.clocks
        if clocks is None or clocks.busy:
            return b""
        if clocks.heard == pipeline.config.spec.nodes:
            self._calls_left = MOST_CALLS
        elif self._calls_left and now_s >= self._next_call_s and pipeline.can_call_roll:
            spec = pipeline.config.spec
            self._calls_left -= 1
            self._next_call_s = now_s + PATIENCE_S + 2 * spec.nodes * spec.frame_period_s
            self.problem = None
            return self._requests(RollCall())
        return b""

    def _why(self, pipeline: Pipeline) -> str:
        """The likely cause of having received no frame for a while."""
        if pipeline.problem:
            return pipeline.problem
        counters = pipeline.parser.counters
        if counters.packets and counters.bytes == self._bytes:
            return "the digitizer has fallen silent: is it still powered?"
        if pipeline.refusal:
            command, reason = pipeline.refusal.command, pipeline.refusal.result.name.lower()
            return f"the digitizer refused command 0x{command:02x}: {reason.replace('_', ' ')}"
        if pipeline.info is None:
            return diagnose(counters)
        if pipeline.counters.restarts > self._restarts + 1:
            return "the digitizer's clock and its count of samples contradict each other"
        if pipeline.rejected:
            return "samples arrive, but no frame fits: check chip_us, order and bits"
        return "the digitizer answers but sends no frames; is the skin connected and powered?"

    def _requests(self, *packets: Packet) -> bytes:
        return b"".join(self._writer.encode(packet) for packet in packets)
