# SPDX-License-Identifier: Apache-2.0

"""The public interface: live frames of a skin (Skin), bytes to frames (Decoder), without ROS.

`import tactile_cdma` offers what stands here; docs/programs.md shows how to use it.
"""

from __future__ import annotations

import math
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .base.arrays import Bools, Floats32, Int32s
from .base.errors import ParameterError, PortError, RecordingEndError, RestError
from .config.parameters import BY_NAME, REPLAY, Value, Values, check_values, read_file
from .config.skin_config import SkinConfig
from .driver.digitizer import Source
from .driver.driver import NOT_YET, Driver
from .driver.pipeline import Pipeline, TactileFrame
from .places.layout import Layout
from .recording.capture import read_bytes
from .sim.indenters import Indenter
from .sim.pressing import press
from .wire.port import Port

BUFFER_S = 1.0
"""Frames that wait for the program span at most this long; chosen to outlast a pause of a plot."""
TIMEOUT_S = 5.0
"""Without a frame for longer, s, something is wrong: a port opens and its digitizer starts within
2 s (driver.RETRY_S)."""
Setting: TypeAlias = Value | list[float]
"""A parameter's value."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One decoded frame of a skin with t taxels and n nodes.

    The arrays are read-only: copy one to change it.

    sequence: counts frame periods on the wire; a step of more than 1 means lost frames.
    t_host: middle of the frame on the host's monotonic clock (time.monotonic), s.
    t_device: the same moment on the digitizer's clock, s.
    stamp_uncertainty_s: t_host may be off by up to this; infinite in the first second, and while
        the digitizer's clock is not known anew after a step.
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
    stamp_uncertainty_s: float
    pressure_pa: Floats32
    voltage_v: Floats32
    status: NDArray[np.uint8]
    positions_m: Floats32
    nodes: Int32s
    active: Bools
    codes: Int32s
    doubtful: Bools
    noise_rms_v: float


class Skin:
    """Frames of a running skin, decoded in a thread of its own.

    >>> from tactile_cdma import Skin
    >>> with Skin("sim://", nodes=16) as skin:
    ...     for frame in skin:
    ...         print(frame.pressure_pa.shape)
    ...         break
    (16,)

    Frames wait for the program for up to BUFFER_S; then the oldest is dropped. Frames of a
    recording are never dropped: its replay waits for the program. A port that is lost is reopened
    automatically.

    port: a device path, `usb://SERIAL`, `replay://FILE`, `sim://` or another pyserial URL.
    timeout_s: after this time without a frame, and two frame periods at least, read() raises
        PortError with the likely cause; None: it waits for ever.
    parameters: by the names, units and limits of docs/parameters.md, as nodes=64, chip_us=50.0.
    config: SkinConfig, what these parameters say.

    ParameterError: raised for an unknown parameter, or a value of another type or out of range.
    SpecError: raised for parameters, or a layout file, that contradict each other.
    CalibrationError: raised for a calibration file that cannot be used.
    PortError: raised by open() for a port that cannot be opened.
    """

    def __init__(
        self, port: str, *, timeout_s: float | None = TIMEOUT_S, **parameters: Setting
    ) -> None:
        values: Values = _checked({"port": port, **parameters})
        if timeout_s is not None and not (isinstance(timeout_s, float | int) and timeout_s > 0):
            raise ParameterError(f"timeout_s is {timeout_s!r}; it must be above 0 s, or None")
        self.config, self.port, self.timeout_s = SkinConfig.of(values), values["port"], timeout_s
        self._baud: int = values.get("baud", BY_NAME["baud"].default)
        self._opening = threading.Lock()  # one thread opens, closes or tares
        self._inbox = _Inbox(self.config, self.port)
        self._driver: Driver | None = None
        self._end: weakref.finalize[..., Skin] | None = None

    def __repr__(self) -> str:
        return f"Skin({self.port!r})"

    @property
    def layout(self) -> Layout:
        """Where the taxels are."""
        return self.config.layout

    @property
    def source(self) -> Source:
        """Who measures: a board or a simulator, now or when a recording was made.

        Its origin is Origin.UNKNOWN until the digitizer has introduced itself, which it does before
        the first frame, and again after a connection was lost.
        """
        driver = self._driver
        return Source.of_port(self.port, driver.pipeline.digitizer.info if driver else None)

    @property
    def dropped(self) -> int:
        """Frames dropped since the port was opened, because the program was too slow."""
        return self._inbox.dropped

    @property
    def problem(self) -> str | None:
        """Why no frames arrive at the moment, in one sentence; None while they do."""
        driver = self._running()
        return None if self._inbox.frames else driver.problem

    def open(self) -> Skin:
        """Open the port and begin to decode; raises PortError if the port cannot be opened."""
        with self._opening:
            if self._driver is None:
                port = Port(self.port, self._baud)
                inbox = self._inbox = _Inbox(self.config, self.port)
                driver = Driver(self.config, self.port, self._baud, inbox.take, inbox.wake)
                # Nothing of the driver refers to this object, so that one that is forgotten, and
                # the interpreter's exit, end the stream as well.
                self._end = weakref.finalize(self, _end, driver, inbox)
                self._driver = driver
                driver.start(port)
        return self

    def close(self) -> None:
        """Stop the digitizer and close the port; frames that wait are discarded."""
        with self._opening:
            self._driver = None
            if self._end is not None:
                self._end()

    def __enter__(self) -> Skin:
        return self.open()

    def __exit__(self, *_: object) -> None:
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

        Raises PortError after timeout_s without one, RecordingEndError at the end of a recording.
        """
        with self._awaited() as frames:
            return _frame(frames.popleft(), self.layout)

    def newest(self) -> Frame:
        """The newest frame that was not returned yet, waited for; older ones are skipped.

        Raises as read().
        """
        with self._awaited() as frames:
            newest = frames[-1]
            frames.clear()
            return _frame(newest, self.layout)

    def press(self, *objects: Indenter) -> None:
        """Let these objects, and no others, touch a simulated skin from its next frame on.

        Poses are in the frame of the skin; without objects nothing touches it any more. Raises
        PortError where the port is not sim://?scene=external, or not open.
        """
        press(self._running(), objects)

    def step(self, *objects: Indenter) -> Frame:
        """Let these objects, and no others, touch a simulated skin for one frame; returns it.

        With sim://?scene=external&speed=0, where no frame passes otherwise: the same steps give the
        same frames, however long the program takes in between. Raises PortError as press() and
        read().
        """
        press(self._running(), objects, frames=1)
        return self.read()

    def tare(self, force: bool = False) -> Floats32:
        """Take the present reading as zero until the skin is closed.

        Returns the pressure taken off, (t,) float32, Pa. force: even under load. The next frame
        that is returned has the tare; a replay is decoded up to BUFFER_S ahead of the program, and
        is tared there. Raises RestError if no frames arrive and, without force, while something
        touches or moves the skin; PortError if the skin is not open.
        """
        with self._opening:
            driver, inbox = self._running(), self._inbox
            if driver.problem not in NOT_YET:  # the first frames may be on their way
                raise RestError(f"not tared: no frames arrive: {driver.problem}")
            with inbox.unbounded(), driver.between_frames() as pipeline:
                taxels = pipeline.taxels
                taxels.tare(pipeline.config.rest.contact_pa, force)
                tare_pa = taxels.baseline.tare_pa.copy()
                if not inbox.lossless:
                    inbox.clear()
        source = self.layout.source
        if source is None:
            return tare_pa
        return np.where(source < 0, np.float32(0), tare_pa[source])

    def _running(self) -> Driver:
        if (driver := self._driver) is None:
            raise PortError(f"{self.port}: not open; use `with Skin(...) as skin:` or skin.open()")
        return driver

    @contextmanager
    def _awaited(self) -> Iterator[deque[TactileFrame]]:
        """The frames that wait, at least one, while none is added."""
        self._running()
        inbox, begun_s = self._inbox, time.monotonic()
        limit_s = math.inf
        if self.timeout_s is not None:
            limit_s = max(self.timeout_s, 2 * self.config.spec.frame_period_s)
        with inbox.changed:
            while not inbox.frames:
                driver = self._running()
                reason = driver.silence.removeprefix(f"{self.port}: ")
                if driver.ended:
                    problem = driver.pipeline.problem
                    if problem and not driver.pipeline.counters.frames:
                        raise PortError(f"{self.port}: no frame in it: {problem}")
                    raise RecordingEndError(f"{self.port}: {reason}")
                if time.monotonic() - begun_s >= limit_s:
                    raise PortError(f"{self.port}: no frame for {limit_s:g} s: {reason}")
                inbox.changed.wait(0.1)  # the driver's thread may end without a word
            yield inbox.frames
            inbox.changed.notify_all()


class _Inbox:
    """Frames on their way from the driver's thread to the program.

    lossless: the driver waits while too many frames wait, which holds its lock; else the oldest
    frame is dropped.
    """

    def __init__(self, config: SkinConfig, port: str) -> None:
        self.frames: deque[TactileFrame] = deque()
        self.changed = threading.Condition()
        self.dropped = 0
        self.closed = False
        self.lossless = port.lower().startswith(REPLAY)
        self._most = max(2, round(BUFFER_S / config.spec.frame_period_s))
        self._unbounded = False

    def take(self, frame: TactileFrame) -> None:
        """Called by the driver's thread for every frame."""
        with self.changed:
            while self.lossless and len(self.frames) >= self._most:
                if self.closed or self._unbounded:
                    break
                self.changed.wait()
            self.frames.append(frame)
            if len(self.frames) > self._most and not self.lossless:
                self.frames.popleft()
                self.dropped += 1
            self.changed.notify_all()

    def wake(self, problem: str | None = None) -> None:
        """Let all threads that wait look again."""
        with self.changed:
            self.changed.notify_all()

    def clear(self) -> None:
        """Discard the frames that wait; never between another thread's look and its taking one."""
        with self.changed:
            self.frames.clear()

    @contextmanager
    def unbounded(self) -> Iterator[None]:
        """Meanwhile any number of frames is taken, so that the driver's lock becomes free."""
        self._unbounded = True
        self.wake()
        try:
            yield
        finally:
            self._unbounded = False


def _end(driver: Driver, inbox: _Inbox) -> None:
    """End a stream, whoever waits for it."""
    inbox.closed = True
    inbox.wake()
    driver.stop()
    inbox.clear()


class Decoder:
    """Bytes of a digitizer → frames, without I/O, threads or a clock of its own.

    >>> from tactile_cdma import Decoder
    >>> decoder = Decoder(nodes=16)
    >>> decoder.feed(b"noise on the wire", t_host=0.0)
    []

    Any split of the bytes gives the same frames; line noise raises nothing.

    parameters: as those of Skin; port and baud have no effect.

    Raises ParameterError, SpecError and CalibrationError as Skin does.
    """

    def __init__(self, **parameters: Setting) -> None:
        self._pipeline = Pipeline(SkinConfig.of(_checked(parameters)), background=False)

    @property
    def layout(self) -> Layout:
        """Where the taxels are."""
        return self._pipeline.config.layout

    @property
    def problem(self) -> str | None:
        """Why nothing can be decoded at the moment, in one sentence; None while all is well."""
        pipeline = self._pipeline
        if pipeline.problem is None and pipeline.digitizer.info is None:
            counts = pipeline.packet_counts
            return (
                f"no description of a digitizer yet, which sends one every second: "
                f"{counts.packets} packets in {counts.bytes} bytes so far"
            )
        return pipeline.problem

    def feed(self, data: bytes | bytearray | memoryview, t_host: float) -> list[Frame]:
        """Frames that these bytes complete; t_host: when they were read, monotonic, s."""
        if not math.isfinite(t_host):
            raise ValueError(f"t_host is {t_host}; it must be a time in s, as of time.monotonic()")
        frames = self._pipeline.feed(memoryview(data).tobytes(), t_host)
        return [_frame(frame, self.layout) for frame in frames]

    def flush(self) -> list[Frame]:
        """Frames that still waited for what follows them: call it where the bytes end."""
        return [_frame(frame, self.layout) for frame in self._pipeline.flush()]


def read_parameters(path: str | PathLike[str]) -> dict[str, Any]:
    """Parameters of a ROS 2 parameter file, for `Skin(**read_parameters("skin.yaml"))`.

    Raises ParameterError, naming file and line, for anything else and for wrong values.
    """
    return read_file(Path(path))


def read_recording(path: str | PathLike[str]) -> Iterator[tuple[bytes, float]]:
    """Bytes of a recording, and when they were read (monotonic, s), for a Decoder.

    Damaged records of a recording are skipped; `tactile-cdma info` counts them. Any other file is
    taken as the bytes of a port, at time 0. Raises CaptureError, when the first bytes are asked
    for, if the file cannot be read.
    """
    return read_bytes(Path(path))


def _checked(parameters: Mapping[str, object]) -> dict[str, Value]:
    """Parameters in their own types; paths and numpy's scalars and arrays are taken, too."""
    plain: dict[str, object] = {}
    for name, value in parameters.items():
        if isinstance(value, np.generic | np.ndarray):
            value = value.tolist()
        plain[name] = fspath(value) if isinstance(value, PathLike) else value
    return check_values(plain)


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """The same array, which the decoder goes on using, for a program that only reads it."""
    view = array.view()
    view.flags.writeable = False
    return view


def _frame(frame: TactileFrame, layout: Layout) -> Frame:
    words, readings = frame.words, frame.readings
    return Frame(
        sequence=frame.sequence,
        t_host=frame.t_host,
        t_device=frame.t_middle,
        stamp_uncertainty_s=frame.stamp_uncertainty_s,
        pressure_pa=_read_only(readings.pressure_pa),
        voltage_v=_read_only(readings.voltage_v),
        status=_read_only(readings.status),
        positions_m=_read_only(layout.positions_m),
        nodes=_read_only(layout.nodes),
        active=_read_only(words.active),
        codes=_read_only(words.codes),
        doubtful=_read_only(words.doubtful),
        noise_rms_v=words.noise_rms_v,
    )
