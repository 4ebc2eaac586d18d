# SPDX-License-Identifier: Apache-2.0

"""The public interface: live frames of a skin (Skin), bytes to frames (Decoder), without ROS.

`import tactile_cdma` offers what stands here; docs/python.md shows how to use it.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from .base.errors import PortError, RecordingEndError, RestError
from .config.parameters import BY_NAME, REPLAY, Value, Values, check_values, read_file
from .config.skin_config import SkinConfig
from .driver.driver import WAITING, Driver
from .driver.pipeline import Pipeline, TactileFrame
from .places.layout import Layout
from .recording.capture import read_bytes
from .wire.port import Port

BUFFER_S = 1.0
"""Frames that wait for the program span at most this long; chosen to outlast a pause of a plot."""
TIMEOUT_S = 5.0
"""Without a frame for longer, s, something is wrong: a port opens and its digitizer starts within
2 s (driver.RETRY_S)."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One decoded frame of a skin with t taxels and n nodes. Treat the arrays as read-only.

    sequence: counts frame periods on the wire; a step of more than 1 means lost frames.
    t_host: middle of the frame on the host's monotonic clock (time.monotonic), s.
    t_device: the same moment on the digitizer's clock, s.
    pressure_pa: (t,) float32, Pa; NaN where there is no valid reading.
    voltage_v: (t,) float32, V, of the taxels' sensors; NaN likewise.
    status: (t,) uint8, bits of tactile_cdma.Status; 0 is a fresh, valid reading.
    positions_m: (t, 3) float32, centres of the taxels in the frame of the skin, m.
    nodes: (t,) int32, number of the node behind each taxel, from 1; 0: none.
    active: (n,) bool, which nodes spoke in this frame; node i + 1 is element i.
    codes: (n,) int32, their ADC codes; 0 where a node did not speak.
    doubtful: (n,) bool, words that may be wrong.
    noise_rms_v: noise of the line, V.
    """

    sequence: int
    t_host: float
    t_device: float
    pressure_pa: NDArray[np.float32]
    voltage_v: NDArray[np.float32]
    status: NDArray[np.uint8]
    positions_m: NDArray[np.float32]
    nodes: NDArray[np.int32]
    active: NDArray[np.bool_]
    codes: NDArray[np.int32]
    doubtful: NDArray[np.bool_]
    noise_rms_v: float


class Skin:
    """Frames of a running skin, decoded in a thread of its own.

    >>> from tactile_cdma import Skin
    >>> with Skin("sim://", nodes=16) as skin:
    ...     for frame in skin:
    ...         print(frame.pressure_pa.shape)
    ...         break
    (16,)

    port: a device path, `usb://SERIAL`, `replay://FILE`, `sim://` or any other pyserial URL.
    parameters: by the names, units and limits of docs/parameters.md, as nodes=64 or chip_us=50.0.
    timeout_s: without a frame for longer, PortError is raised with the likely cause; None: wait
    forever. A port that is lost is opened again by itself meanwhile.

    Frames wait for the program for up to BUFFER_S; then the oldest is dropped (`dropped`). Frames
    of a recording are never dropped: its replay waits for the program.

    Raises ParameterError or SpecError for wrong parameters, PortError from open() for a port that
    cannot be opened.
    """

    def __init__(
        self, port: str, *, timeout_s: float | None = TIMEOUT_S, **parameters: Value
    ) -> None:
        values: Values = check_values({"port": port, **parameters})
        self.config = SkinConfig.of(values)
        self.port, self.timeout_s = port, timeout_s
        self.dropped = 0
        self._baud: int = values.get("baud", BY_NAME["baud"].default)
        self._most = max(2, round(BUFFER_S / self.config.spec.frame_period_s))
        self._frames: deque[TactileFrame] = deque()
        self._changed = threading.Condition()
        self._driver: Driver | None = None
        self._drain = False  # frames are taken however many wait, so that the driver's lock is free

    @property
    def layout(self) -> Layout:
        """Where the taxels are."""
        return self.config.layout

    @property
    def problem(self) -> str | None:
        """Why no frames come just now, in one sentence; None while they do."""
        return self._running().problem

    def open(self) -> Skin:
        """Open the port and begin to decode; raises PortError where the port cannot be opened."""
        if self._driver is None:
            port = Port(self.port, self._baud)
            self._frames.clear()
            self._driver = Driver(self.config, self.port, self._baud, self._take, self._wake)
            self._driver.start(port)
        return self

    def close(self) -> None:
        """Stop the digitizer, close the port; frames that wait are given up."""
        driver, self._driver = self._driver, None
        self._wake()
        if driver is not None:
            driver.stop()
        self._frames.clear()

    def __enter__(self) -> Skin:
        return self.open()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        """Every frame in order, until a recording ends; raises PortError as read() does."""
        while True:
            try:
                frame = self.read()
            except RecordingEndError:
                return
            yield frame

    def read(self) -> Frame:
        """The next frame in order, waited for.

        Raises PortError after timeout_s without one, RecordingEndError at a recording's end.
        """
        with self._changed:
            self._await_frame()
            frame = self._frames.popleft()
            self._changed.notify_all()
        return _frame(frame, self.layout)

    def newest(self) -> Frame:
        """The newest frame that was not returned yet, waited for; older ones are passed over.

        Raises as read().
        """
        with self._changed:
            self._await_frame()
            frame = self._frames[-1]
            self._frames.clear()
            self._changed.notify_all()
        return _frame(frame, self.layout)

    def tare(self, force: bool = False) -> NDArray[np.float32]:
        """Take what the skin reads now for zero, until the skin is closed.

        Returns the pressure taken off, (t,) float32, Pa. force: even under load. Raises RestError
        where no frames arrive, and without force where something touches or moves the skin.
        """
        driver = self._running()
        if driver.problem not in (None, WAITING):  # the first frames may be on their way
            raise RestError(f"not tared: no frames arrive: {driver.problem}")
        with self._changed:
            self._drain = True
            self._changed.notify_all()
        try:
            with driver.between_frames() as pipeline:
                taxels = pipeline.taxels
                taxels.tare(pipeline.config.rest.contact_pa, force)
                tare_pa = taxels.baseline.tare_pa.copy()
        finally:
            self._drain = False
        source = self.layout.source
        if source is None:
            return tare_pa
        return np.where(source < 0, np.float32(0), tare_pa[source])

    def _running(self) -> Driver:
        if self._driver is None:
            raise PortError(f"{self.port}: not open; use `with Skin(...) as skin:` or skin.open()")
        return self._driver

    def _await_frame(self) -> None:
        """Wait for a frame, holding the condition's lock."""
        waited_from_s = time.monotonic()
        while (driver := self._running()) and not self._frames:
            if driver.ended:
                raise RecordingEndError(f"{self.port}: {driver.problem}")
            waited_s = time.monotonic() - waited_from_s
            if self.timeout_s is not None and waited_s >= self.timeout_s:
                reason = driver.problem or "the stream has stopped"
                raise PortError(f"{self.port}: no frame for {self.timeout_s:g} s: {reason}")
            self._changed.wait(0.1)  # the driver's thread may end without a word

    def _take(self, frame: TactileFrame) -> None:
        """Called by the driver's thread for every frame."""
        with self._changed:
            while self.port.startswith(REPLAY) and len(self._frames) >= self._most:
                if self._driver is None or self._drain:
                    break
                self._changed.wait()
            self._frames.append(frame)
            if len(self._frames) > self._most and not self.port.startswith(REPLAY):
                self._frames.popleft()
                self.dropped += 1
            self._changed.notify_all()

    def _wake(self, problem: str | None = None) -> None:
        """Let all who wait look again."""
        with self._changed:
            self._changed.notify_all()


class Decoder:
    """Bytes of a digitizer → frames, without I/O, threads or a clock of its own.

    >>> from tactile_cdma import Decoder
    >>> decoder = Decoder(nodes=16)
    >>> decoder.feed(b"noise on the wire", t_host=0.0)
    []

    parameters: as those of Skin. Any split of the bytes gives the same frames; line noise raises
    nothing. problem: why nothing can be decoded just now, in one sentence; None while all is well.
    Raises ParameterError or SpecError for wrong parameters.
    """

    def __init__(self, **parameters: Value) -> None:
        self._pipeline = Pipeline(SkinConfig.of(parameters), background=False)

    @property
    def layout(self) -> Layout:
        """Where the taxels are."""
        return self._pipeline.config.layout

    @property
    def problem(self) -> str | None:
        """Why nothing can be decoded just now, in one sentence; None while all is well."""
        return self._pipeline.problem

    def feed(self, data: bytes, t_host: float) -> list[Frame]:
        """Frames that these bytes complete; t_host: when they were read, monotonic, s."""
        return [_frame(frame, self.layout) for frame in self._pipeline.feed(data, t_host)]

    def flush(self) -> list[Frame]:
        """Frames that still waited for what follows them: call it where the bytes end."""
        return [_frame(frame, self.layout) for frame in self._pipeline.flush()]


def read_parameters(path: str | PathLike[str]) -> Mapping[str, Value]:
    """Parameters of a ROS 2 parameter file, for `Skin(**read_parameters("skin.yaml"))`.

    Raises ParameterError, naming file and line, for a file that is none or has a wrong value.
    """
    return read_file(Path(path))


def read_recording(path: str | PathLike[str]) -> Iterator[tuple[bytes, float]]:
    """Bytes of a recording or raw capture, and when they were read (monotonic, s), for a Decoder.

    Raises CaptureError for a file that is none, or is damaged.
    """
    return read_bytes(Path(path))


def _frame(frame: TactileFrame, layout: Layout) -> Frame:
    words, readings = frame.words, frame.readings
    return Frame(
        sequence=frame.sequence,
        t_host=frame.t_host,
        t_device=frame.t_middle,
        pressure_pa=readings.pressure_pa,
        voltage_v=readings.voltage_v,
        status=readings.status,
        positions_m=layout.positions_m,
        nodes=layout.nodes,
        active=words.active,
        codes=words.codes,
        doubtful=words.doubtful,
        noise_rms_v=words.noise_rms_v,
    )
