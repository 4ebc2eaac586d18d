# SPDX-License-Identifier: Apache-2.0

"""A running skin: port, handshake and decoding in one thread, reconnecting by itself."""

import logging
import math
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self

from ..base.errors import PortError, RecordingEndError
from ..base.text import plain_lines
from ..config.parameters import REPLAY
from ..config.skin_config import SkinConfig, fills_period
from ..readings.stuck import LOOK_S as STUCK_LOOK_S
from ..readings.stuck import StuckNodes
from ..wire.discovery import is_away
from ..wire.messages import Info
from ..wire.packets import MAX_REPEATED
from ..wire.port import READ_TIMEOUT_MS, Port, is_remote
from ..wire.reader import NO_FILE
from .checkup import OTHER_SENSORS, REJECTED_FOR
from .pipeline import Pipeline, TactileFrame
from .scrambling import ScrambleWatch
from .session import Session
from .vitals import Vitals

CONNECT_S = 0.5
"""s that stopping waits for a port that is just being opened. Chosen: a sound port takes less."""
RETRY_S = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""s between attempts to get frames from a port; the last pause repeats. Chosen: a plug that bounces
is back at once, and a port that stays away costs next to nothing."""
AWAY_S = 0.02
"""s between looks for a device that is missing. Chosen: a look takes microseconds."""
LOOK_S = 0.2
"""s between looks at how much waits in the port, and at the session, while frames come. Chosen: a
look takes 60 µs after a pause; a backlog has to last for a second, and the session waits longer."""
CONNECTING = "connecting to the host of the port"
"""The problem while a port on another machine is opened for the first time."""
WAITING = "waiting for the first frame"
"""The problem right after a port was opened."""
NOT_YET = (None, CONNECTING, WAITING)
"""Problems that pass by themselves, if nothing is wrong."""
LATE_S, LATE_PERIODS = 0.25, 2.0
"""s, frame periods; a frame read later than their sum after its middle is late. Chosen: below
clock.SLOW_S, from which on late packets could be taken for those of a slow device."""
CATCH_UP_S = 1.0
"""s for which a driver that was held up may catch up without losing anything; chosen."""
_log = logging.getLogger(__name__)


class Driver:
    """Runs one skin in a thread of its own until stopped.

    on_frame is called in that thread for every frame; on_problem with one sentence whenever the
    reason for not receiving frames changes, and with None when frames flow again; on_info with what
    the digitizer says that it is, where that fits and is new, before a frame of it is decoded.

    url: of the port. port: while one is open. connections: how often it was opened.
    problem: as told by on_problem. vitals: what the thread measures of itself.
    stuck: finds nodes that do not move. scrambling: finds nodes that scramble otherwise, on the
    present connection.
    ended: a recording was replayed to its end, and no more frames will come.
    """

    def __init__(
        self,
        config: SkinConfig,
        url: str,
        baud: int,
        on_frame: Callable[[TactileFrame], None],
        on_problem: Callable[[str | None], None],
        on_info: Callable[[Info], None] = lambda info: None,
    ) -> None:
        # A recording may be played in a loop.
        self._replays = url.lower().startswith(REPLAY)
        most_repeated = 0 if self._replays else MAX_REPEATED
        self.pipeline = Pipeline(config, most_repeated=most_repeated)
        self.pipeline.on_info = on_info
        self.problem: str | None = None
        self.connections = 0
        self.ended = False
        self.vitals = Vitals()
        self.stuck = StuckNodes(config.layout)
        self.scrambling = ScrambleWatch(config)
        self._first_port: Port | None = None
        self.port: Port | None = None
        self.url, self._baud = url, baud
        self._on_frame, self._on_problem = on_frame, on_problem
        self._stop = threading.Event()
        self._opening = False
        self._rejected = 0  # before expect_frames()
        self._fills = fills_period(config.spec, config.samples_per_chip)
        self._may_end = False  # a stepped frame, of whose end no samples will come
        self._busy = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=f"skin {url}", daemon=True)

    def start(self, port: Port | None = None) -> None:
        """Begin to stream; port: already open, if there is one (the driver closes it)."""
        self._first_port = self.port = port
        self._thread.start()

    def stop(self) -> None:
        """Stop the digitizer, close the port, join the thread; nothing is called from now on.

        A thread that is connecting to a host that does not answer is not joined: it ends by itself
        when that fails. Nor is the driver's own, which may be the one to collect who is forgotten.
        """
        self._stop.set()
        while self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(CONNECT_S)
            if self._opening:
                return

    def expect_frames(self) -> None:
        """Note that a program lets frames pass: what is rejected from now on explains silence."""
        self._rejected = self.pipeline.rejections.total

    @property
    def silence(self) -> str:
        """Tell why no frame comes, if none does: the problem, or what else may be the cause."""
        port = self.port
        if port is not None and port.stepped and self.problem in (None, WAITING):
            rejections = self.pipeline.rejections
            if rejections.total > self._rejected:
                return f"frames are rejected, mostly {REJECTED_FOR[rejections.leading]}"
            return self.pipeline.problem or "frames pass one step() at a time"
        return self.problem or "the stream has stopped"

    @contextmanager
    def between_frames(self) -> Iterator[Pipeline]:
        """Yield the pipeline while no frame is decoded or handed on, to another thread.

        Bytes wait in the port meanwhile, so keep it short.
        """
        with self._busy:
            yield self.pipeline

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run(self) -> None:
        attempt = 0
        while not self._stop.is_set():
            frames = self.pipeline.counters.frames
            try:
                with self._open() as port:
                    if self._stop.is_set():
                        return
                    self.connections += 1
                    self.port = port
                    self._stream(port)
            except RecordingEndError as end:
                self._report(str(end))
                self.ended = True
                return
            except PortError as error:
                self._report(str(error))
            except Exception:  # a defect must neither go unseen nor end the skin for good
                trace = plain_lines(traceback.format_exc())
                self._report(f"internal error, starting again: {trace}")
            finally:
                self.port = None
            if self.pipeline.counters.frames > frames:
                attempt = 0
            came_back = self._pause(RETRY_S[min(attempt, len(RETRY_S) - 1)])
            attempt = 0 if came_back else attempt + 1

    def _pause(self, pause_s: float) -> bool:
        """Wait before the port is opened again; returns True at once when a missing one is back."""
        end_s, away = time.monotonic() + pause_s, is_away(self.url)
        while (left_s := end_s - time.monotonic()) > 0:
            if self._stop.wait(min(left_s, AWAY_S)):
                return False
            if away and not is_away(self.url):
                return True
        return False

    def _open(self) -> Port:
        """Return the port given at the start, once, then a newly opened one; raises PortError."""
        first, self._first_port = self._first_port, None
        if first is not None:
            return first
        self._opening = True
        if not self.problem and is_remote(self.url):
            self._report(CONNECTING)
        try:
            return Port(self.url, self._baud, self.pipeline.config.layout)
        finally:
            self._opening = False

    def _stream(self, port: Port) -> None:
        """Start the digitizer and decode until stopped; raises PortError when the port is lost."""
        pipeline = self.pipeline
        session = Session(pipeline.config, port.stepped)
        self.scrambling = ScrambleWatch(pipeline.config)
        _check_simulated(port, pipeline.config)
        with self._busy:
            pipeline.reconnected()
        if self.problem in NOT_YET:
            self._report(WAITING)
        port.write(session.open())
        backlog = Backlog(pipeline.config.spec.frame_period_s)
        look_s, age_s, file, timeout_ms = -math.inf, 0.0, port.file, READ_TIMEOUT_MS
        heard_s = time.monotonic()
        try:
            while not self._stop.is_set():
                last, t_host = self._next(port, session, file, timeout_ms)
                if last:
                    age_s, heard_s = t_host - last.t_host, t_host
                    if self.problem:
                        self._report(None)
                    if t_host < look_s:
                        continue
                if t_host >= look_s:
                    look_s = t_host + LOOK_S
                    self._look(port, backlog, age_s, t_host)
                if request := session.watch(pipeline, t_host, heard_s):
                    port.write(request)
                    told = self.scrambling.problem or port.problem or session.problem
                    self._report(told or self.problem)
                left_ms = math.ceil(1e3 * max(0.0, session.deadline_s - t_host))
                timeout_ms = min(left_ms or READ_TIMEOUT_MS, READ_TIMEOUT_MS)
        finally:
            if self._stop.is_set():
                port.write(session.close())

    def _look(self, port: Port, backlog: "Backlog", age_s: float, t_host: float) -> None:
        """See to what need not be seen to with every frame. age_s: of the newest one."""
        waiting_bytes = port.waiting
        self.vitals.note_read(waiting_bytes)
        if not self.scrambling.is_over and self.scrambling.look(self.pipeline):
            _log.error("%s: %s", port.url, self.scrambling.problem)
        if port.over_network and backlog.observe(waiting_bytes, age_s, t_host):
            with self._busy:
                for frame in self.pipeline.drain():
                    self._hand_on(frame, t_host)
                self.pipeline.skipped(port.skip())

    def _next(
        self, port: Port, session: Session, file: int, timeout_ms: int
    ) -> tuple[TactileFrame | None, float]:
        """Go on to what comes next: a frame that was handed on, if it is one; when it was read.

        file: see Port.file. timeout_ms: most that is waited for bytes there.
        """
        pipeline, listens = self.pipeline, self.scrambling.listens
        if listens:
            file = NO_FILE
        try:
            event = pipeline.stream.next(file, timeout_ms)
        except OSError as error:
            raise port.lost(error) from None
        with self._busy:
            frame = pipeline.take(event)
            if frame is not None:
                try:  # first, as whoever takes the frame may let the next one pass
                    asks = pipeline.asking.wanted and not self._replays
                    if asks and (request := session.ask(pipeline, event.t_host)):
                        port.write(request)
                finally:
                    self._hand_on(frame, event.t_host)
        if not event.needs_bytes:
            return frame, event.t_host
        if file == NO_FILE:
            if self._may_end and not port.waiting:
                # Nothing follows the frame of a step before the next step.
                self._may_end = False
                pipeline.stream.end()
                return None, time.monotonic()
            data, t_host = port.read()
            if listens:
                self.scrambling.note(data, t_host)
            self._may_end = bool(data) and port.stepped and self._fills
            pipeline.stream.give(data, t_host, port.had_waited)
        return None, time.monotonic()

    def _hand_on(self, frame: TactileFrame, t_host: float) -> None:
        """Pass a decoded frame to whoever uses it. t_host: when its bytes were read."""
        t_decoded = time.monotonic()
        self._on_frame(frame)
        if not self.scrambling.is_over:
            self.scrambling.hear(frame)
        done = t_host, t_decoded, time.monotonic(), frame.clipped, frame.words.noise_rms_v
        self.vitals.handed_on.append((frame.t_host, *done))
        if not 0 <= frame.t_middle - self.stuck.looked_s < STUCK_LOOK_S:
            contact_pa = self.pipeline.config.rest.contact_pa
            self.stuck.look(frame.readings, frame.t_middle, contact_pa)

    def _report(self, problem: str | None) -> None:
        if problem != self.problem and not self._stop.is_set():
            self.problem = problem
            try:
                self._on_problem(problem)
            except Exception:  # what is told of a fault must not be the end of the thread
                _log.exception("a listener for problems failed")


class Backlog:
    """Tells a driver that is too slow from one that was held up for a moment.

    If bytes wait at every look for CATCH_UP_S, and the frames in them are late, the driver does not
    catch up by reading alone.
    """

    def __init__(self, period_s: float) -> None:
        """period_s: of the frames."""
        self._late_s = LATE_S + LATE_PERIODS * period_s
        self._since_s = math.inf

    def observe(self, waiting_bytes: int, age_s: float, now_s: float) -> bool:
        """Note a look at the port; whether to discard what waits. age_s: of the newest frame."""
        if not waiting_bytes or age_s <= self._late_s:
            self._since_s = math.inf
            return False
        self._since_s = min(self._since_s, now_s)
        if now_s - self._since_s < CATCH_UP_S:
            return False
        self._since_s = math.inf
        return True


def _check_simulated(port: Port, config: SkinConfig) -> None:
    """Warn of a simulated skin whose readings are others than what presses on it.

    Raises PortError for one of nodes that do not repeat, where the driver counts on that.
    """
    skin = getattr(port.device, "simulated", None)
    if skin is None:
        return
    if not skin.sensors.is_read_by(config.calibration, config.curve, config.adc):
        _log.warning("%s: %s", port.url, OTHER_SENSORS)
    if config.nodes_repeat and not skin.rules(config.spec).follow:
        raise PortError(
            f"{port.url}: nodes_repeat is true, but these nodes speak only when their value has "
            "changed: set nodes_repeat to false, or speaks=rest in the port"
        )
