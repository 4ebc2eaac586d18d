# SPDX-License-Identifier: Apache-2.0

"""The public interface: live frames of a skin (Skin), bytes to frames (Decoder), without ROS.

`import tactile_cdma` offers what stands here; docs/programs.md shows how to use it.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from os import PathLike
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .base.arrays import Bools, Floats, Floats32, Int32s
from .base.errors import ParameterError, PortError, RecordingEndError, Refusal, RestError
from .base.text import listed
from .config.parameters import BY_NAME, REPLAY, Value, Values, read_file
from .config.python_arguments import argument, forced, parameters_of, path_of, seconds, timeout
from .config.skin_config import SkinConfig
from .driver.digitizer import Source
from .driver.driver import NOT_YET, Driver
from .driver.pipeline import Pipeline, TactileFrame
from .places.layout import Layout
from .readings.contact import Contacts, ContactTracker, Felt, wrench_covariance
from .recording.recording_file import read_bytes
from .sim.indenters import Indenter
from .sim.pressing import press
from .wire.port import Port

BUFFER_S = 1.0
"""Frames that wait for the program span at most this long; chosen to outlast a pause of a plot."""
TIMEOUT_S = 5.0
"""Time without a frame, s, after which something is wrong: a port opens and its digitizer starts
within 2 s (driver.RETRY_S)."""
LATEST_S = 0.5
"""A frame that arrived longer ago, s, and two frame periods at least, is not the present one unless
the program says so; chosen as datasets.alignment.STALE_S."""
LOOK_S = 0.1
"""Interval of looks at the driver's thread, which may end without a word, and of attempts to tare,
s; chosen."""
_log = logging.getLogger(__name__)
Setting: TypeAlias = Value | list[float]
"""A parameter's value."""
_SKINS: weakref.WeakSet[Skin] = weakref.WeakSet()


@dataclass(frozen=True, slots=True, eq=False)
class Frame(Felt):
    """One decoded frame of a skin with t taxels and n nodes.

    The arrays are read-only: copy one to change it.

    sequence: counts frame periods on the wire; a step of more than 1 means lost frames.
    t_host: middle of the frame on the host's monotonic clock (time.monotonic), s.
    t_device: the same moment on the digitizer's clock, s.
    stamp_uncertainty_s: t_host may be off by up to this; infinite in the first second, and while
        the digitizer's clock is not known anew after a step.
    pressure_pa: (t,) float32, Pa; NaN where there is no valid reading.
    voltage_v: (t,) float32, V, of the taxels' sensors; NaN as pressure_pa.
    status: (t,) uint8, bits of tactile_cdma.Status; 0 is a fresh, valid reading.
    positions_m: (t, 3) float32, centres of the taxels in the frame of the skin, m.
    shape: rows and columns of the taxels, which are row-major; an irregular skin has one row.
    nodes: (t,) int32, number of the node behind each taxel, from 1; 0: none.
    active: (n,) bool, which nodes spoke in this frame; node i + 1 is element i.
    codes: (n,) int32, their ADC codes; 0 where a node did not speak.
    doubtful: (n,) bool, words that may be wrong.
    noise_rms_v: noise of the line, V.
    contacts: what touches, as in TactileContacts; None unless contacts=True was asked for.
    sigma_pa: (t,) float32, how sure pressures are, 1 σ, Pa: NaN where that is unknown, infinite
        beyond the range. wrench_covariance: (6, 6), N² to (N m)², of the wrench, NaN while that is
        unknown. None unless publish_sigma=True was asked for, the latter with contacts=True.
    """

    sequence: int
    t_host: float
    t_device: float
    stamp_uncertainty_s: float
    pressure_pa: Floats32
    voltage_v: Floats32
    status: NDArray[np.uint8]
    positions_m: Floats32
    shape: tuple[int, int]
    nodes: Int32s
    active: Bools
    codes: Int32s
    doubtful: Bools
    noise_rms_v: float
    contacts: Contacts | None
    sigma_pa: Floats32 | None = None
    wrench_covariance: Floats | None = None

    def __repr__(self) -> str:
        valid = np.count_nonzero(np.isfinite(self.pressure_pa))
        most = f", at most {np.nanmax(self.pressure_pa) / 1e3:.1f} kPa" if valid else ""
        return f"Frame({self.sequence}: {valid} of {len(self.nodes)} taxels valid{most})"

    @property
    def grid(self) -> Floats32:
        """Return the pressure by (rows, columns), Pa."""
        return self.pressure_pa.reshape(self.shape)


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
    contacts: also find contacts, from the first frame on; see Frame.contacts.
    timeout_s: after this time without a frame, and two frame periods at least, read() raises
        PortError with the likely cause; None: it waits for ever.
    parameters: by the names, units and limits of docs/parameters.md, as nodes=64, chip_us=50.0.
    parameters, config: as given, and as SkinConfig with the defaults of the others.

    ParameterError: raised for an unknown parameter, or a value of another type or out of range.
    SpecError: raised for parameters, or a layout file, that contradict each other.
    CalibrationError: raised for a calibration file that cannot be used.
    PortError: raised by open() for a port that cannot be opened.
    """

    def __init__(
        self,
        port: str,
        *,
        contacts: bool = False,
        timeout_s: float | None = TIMEOUT_S,
        **parameters: Setting,
    ) -> None:
        self.contacts: bool = argument("contacts", contacts, False)
        self.timeout_s = timeout("timeout_s", timeout_s)
        values: Values = parameters_of({"port": port, **parameters})
        self.config, self.port = SkinConfig.of(values), values["port"]
        self.parameters = values
        self._baud: int = values.get("baud", BY_NAME["baud"].default)
        self._opening = threading.Lock()  # one thread opens, closes or tares
        self._inbox = self._new_inbox()
        self._driver: Driver | None = None
        self._end: weakref.finalize[..., Skin] | None = None
        self._is_forked = False  # opened by the parent of this process
        _SKINS.add(self)

    def __repr__(self) -> str:
        return f"Skin({self.port!r})"

    @property
    def layout(self) -> Layout:
        """Tell where the taxels are."""
        return self.config.layout

    @property
    def source(self) -> Source:
        """Tell who measures: a board or a simulator, now or when a recording was made.

        Its origin is Origin.UNKNOWN until the digitizer has introduced itself, which it does before
        the first frame, and again after a connection was lost.
        """
        driver = self._driver
        return Source.of_port(self.port, driver.pipeline.digitizer.info if driver else None)

    @property
    def dropped(self) -> int:
        """Count the frames dropped since the port was opened, because the program was too slow."""
        return self._inbox.dropped

    @property
    def tared(self) -> bool:
        """Tell whether tare() has taken a zero, which is in force."""
        driver = self._driver
        return driver is not None and driver.pipeline.taxels.baseline.tared

    @property
    def problem(self) -> str | None:
        """Tell why no frames arrive at the moment, in one sentence; None while they do."""
        driver = self._running()
        return None if self._inbox.frames else driver.problem

    @property
    def silence(self) -> str:
        """Tell why no frame comes, if none does, in one sentence."""
        return self._running().silence.removeprefix(f"{self.port}: ")

    @property
    def ended(self) -> bool:
        """Tell whether a recording was replayed to its end, and every frame of it was taken."""
        return self._running().ended and not self._inbox.frames

    def telling(self, listener: Callable[[], None]) -> AbstractContextManager[object]:
        """Call listener, while in this context, whenever a frame has come or is overdue.

        It is called from another thread, which it must not hold up: it may set an event.
        """
        self._running()
        if not callable(listener):
            raise ParameterError(f"listener is {listener!r}; it must be a function")
        return self._inbox.telling(listener)

    def open(self, patiently: bool = False) -> Skin:
        """Open the port and begin to decode.

        Raises PortError if the port cannot be opened; patiently: it is tried again then.
        """
        argument("patiently", patiently, False)
        with self._opening:
            if self._driver is None:
                port = None if patiently else Port(self.port, self._baud, self.layout)
                inbox = self._inbox = self._new_inbox()
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
            self._driver, self._is_forked = None, False
            if self._end is not None:
                self._end()

    def __enter__(self) -> Skin:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        """Yield every frame in order, until a recording ends; raises PortError as read() does."""
        with suppress(RecordingEndError):
            while True:
                yield self.read()

    async def __aiter__(self) -> AsyncIterator[Frame]:
        """Yield every frame without holding up other tasks meanwhile."""
        self._running()
        loop, news = asyncio.get_running_loop(), asyncio.Event()

        def tell() -> None:
            with suppress(RuntimeError):  # the loop was closed
                loop.call_soon_threadsafe(news.set)

        inbox, begun_s = self._inbox, time.monotonic()
        with inbox.telling(tell), suppress(RecordingEndError):
            while True:
                news.clear()
                with inbox.changed:
                    frame = inbox.first() if self._look(inbox, begun_s) else None
                if frame is not None:
                    yield frame
                    begun_s = time.monotonic()
                    continue
                with suppress(TimeoutError):  # Python 3.11's wait_for may swallow a cancellation
                    async with asyncio.timeout(LOOK_S):
                        await news.wait()

    def read(self) -> Frame:
        """Wait for the next frame in order.

        Raises PortError after timeout_s without one, RecordingEndError at the end of a recording.
        """
        with self._awaited() as inbox:
            return inbox.first()

    def newest(self) -> Frame:
        """Wait for the newest frame not returned yet; skips older ones. Raises as read()."""
        with self._awaited() as inbox:
            return inbox.all()[-1]

    def latest(self, max_age_s: float | None = LATEST_S) -> Frame | None:
        """Return the newest frame, at once, also if it was returned before; older ones are skipped.

        None if none arrived within max_age_s and two frame periods (None: at any time), so that a
        skin that fell silent is not taken for one that feels what it felt last.
        """
        self._running()
        if max_age_s is not None:
            max_age_s = seconds("max_age_s", max_age_s)
        inbox = self._inbox
        with inbox.changed:
            inbox.all()
            age_s = time.monotonic() - inbox.heard_s
            if max_age_s is not None and age_s > max(max_age_s, 2 * inbox.period_s):
                return None
            return inbox.latest

    def waiting(self) -> list[Frame]:
        """Return the frames that wait, in order, at once; perhaps none."""
        self._running()
        with self._inbox.changed:
            return self._inbox.all()

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

    def tare(self, force: bool | str = False, wait_s: float = 0.0) -> Floats32:
        """Take the present reading as zero until the skin is closed.

        Returns the pressure taken off, (t,) float32, Pa. force: even under load; "all": also where
        a reading is not certain, which else is left out and logged. wait_s: how long a tare that is
        refused for what may pass, such as too few frames or a touch, is tried again. The next frame
        that is returned has the tare; a replay is decoded up to BUFFER_S ahead of the program, and
        is tared there. Raises RestError, with its reason, if no frames arrive and, without force,
        while something touches or moves the skin; PortError if the skin is not open.
        """
        force = forced(force)
        end_s = time.monotonic() + seconds("wait_s", wait_s)
        while True:
            try:
                return self._tare(force)
            except RestError as error:
                if not (error.reason.may_pass and time.monotonic() < end_s):
                    raise
            time.sleep(LOOK_S)

    def _tare(self, force: bool | str) -> Floats32:
        with self._opening:
            driver, inbox = self._running(), self._inbox
            if driver.problem not in NOT_YET:  # the first frames may be on their way
                reason = f"not tared: no frames arrive: {driver.problem}"
                raise RestError(reason, Refusal.NO_FRAMES)
            with inbox.unbounded(), driver.between_frames() as pipeline:
                taxels = pipeline.taxels
                unheard = taxels.tare(pipeline.config.rest.contact_pa, force)
                tare_pa = taxels.baseline.tare_pa.copy()
                if not inbox.lossless:
                    inbox.clear()
        if unheard:
            nodes = listed(unheard, "node")
            _log.warning("%s: tared without %s: no valid, certain reading", self.port, nodes)
        return self.layout.of_nodes(tare_pa)

    def _running(self) -> Driver:
        if self._is_forked:
            reason = "a Skin does not survive a fork: close it, and open one in this process"
            raise PortError(f"{self.port}: {reason}")
        if (driver := self._driver) is None:
            raise PortError(f"{self.port}: not open; use `with Skin(...) as skin:` or skin.open()")
        return driver

    def _survive(self) -> None:
        """Let go, in the child of a fork, of locks of the parent's threads, and of listeners."""
        self._opening, self._inbox.changed = threading.Lock(), threading.Condition()
        self._inbox.listeners.clear()
        self._is_forked = self._driver is not None

    def _new_inbox(self) -> _Inbox:
        return _Inbox(_Framing(self.config, self.contacts), self.config, self.port)

    @contextmanager
    def _awaited(self) -> Iterator[_Inbox]:
        """Return the inbox, with a frame at least, while none is added."""
        self._running()
        inbox, begun_s = self._inbox, time.monotonic()
        with inbox.changed:
            while not self._look(inbox, begun_s):
                inbox.changed.wait(LOOK_S)
            yield inbox

    def _look(self, inbox: _Inbox, begun_s: float) -> bool:
        """Tell whether a frame waits; raises as read(), which waits since begun_s (monotonic)."""
        if inbox.frames:
            return True
        driver, limit_s = self._running(), math.inf
        if self.timeout_s is not None:
            limit_s = max(self.timeout_s, 2 * inbox.period_s)
        reason = self.silence
        if driver.ended:
            problem = driver.pipeline.problem
            if problem and not driver.pipeline.counters.frames:
                raise PortError(f"{self.port}: no frame in it: {problem}")
            raise RecordingEndError(f"{self.port}: {reason}")
        if time.monotonic() - begun_s >= limit_s:
            raise PortError(f"{self.port}: no frame for {limit_s:g} s: {reason}")
        return False


if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=lambda: [*map(Skin._survive, _SKINS)])

_Found: TypeAlias = tuple[TactileFrame, Contacts | None]
"""A frame, and its contacts if they were asked for."""


class _Framing:
    """Makes the frames that programs get."""

    def __init__(self, config: SkinConfig, contacts: bool) -> None:
        self._layout, self._release_pa = config.layout, config.contact.release_pa
        self._tracker = ContactTracker(config.layout, config.contact) if contacts else None

    def find(self, frame: TactileFrame) -> _Found:
        """Find the contacts of every frame, in order: ages and speeds rest on those before."""
        if self._tracker is None:
            return frame, None
        return frame, self._tracker.update(frame.readings, frame.t_middle)

    def shown(self, found: _Found) -> Frame:
        frame, contacts = found
        layout, words, readings = self._layout, frame.words, frame.readings
        sigma_pa, covariance = readings.sigma_pa, None
        if sigma_pa is not None and contacts is not None:
            sure = readings.pressure_pa, sigma_pa, self._release_pa
            covariance = wrench_covariance(layout, contacts, *sure)
        return Frame(
            sequence=frame.sequence,
            t_host=frame.t_host,
            t_device=frame.t_middle,
            stamp_uncertainty_s=frame.stamp_uncertainty_s,
            pressure_pa=_read_only(readings.pressure_pa),
            voltage_v=_read_only(readings.voltage_v),
            status=_read_only(readings.status),
            positions_m=_read_only(layout.positions_m),
            shape=(layout.rows, layout.columns),
            nodes=_read_only(layout.nodes),
            active=_read_only(words.active),
            codes=_read_only(words.codes),
            doubtful=_read_only(words.doubtful),
            noise_rms_v=words.noise_rms_v,
            contacts=contacts,
            sigma_pa=None if sigma_pa is None else _read_only(sigma_pa),
            wrench_covariance=covariance,
        )


class _Inbox:
    """Frames on their way from the driver's thread to the program.

    lossless: the driver waits while too many frames wait, which holds its lock; else the oldest
    frame is dropped. latest, heard_s: the newest that was taken out, and when one last arrived.
    """

    def __init__(self, framing: _Framing, config: SkinConfig, port: str) -> None:
        self.frames: deque[_Found] = deque()
        self.changed = threading.Condition()
        self.latest: Frame | None = None
        self.heard_s = -math.inf
        self.period_s = config.spec.frame_period_s
        self._framing = framing
        self.listeners: set[Callable[[], None]] = set()
        self.dropped = 0
        self.closed = False
        self.lossless = port.lower().startswith(REPLAY)
        self._most = max(2, round(BUFFER_S / self.period_s))
        self._unbounded = False

    def take(self, frame: TactileFrame) -> None:
        """Process a frame: the driver's thread calls this for every one."""
        found = self._framing.find(frame)
        with self.changed:
            while self.lossless and len(self.frames) >= self._most:
                if self.closed or self._unbounded:
                    break
                self.changed.wait()
            self.frames.append(found)
            self.heard_s = time.monotonic()
            if len(self.frames) > self._most and not self.lossless:
                self.frames.popleft()
                self.dropped += 1
            self.wake()

    def first(self) -> Frame:
        """Return the frame that waits longest, taken out, while self.changed is held."""
        frame = self._framing.shown(self.frames.popleft())
        self.latest = frame if not self.frames else self.latest
        self.changed.notify_all()
        return frame

    def all(self) -> list[Frame]:
        """Return all frames that wait, taken out, while self.changed is held."""
        frames = [self._framing.shown(found) for found in self.frames]
        self.frames.clear()
        self.latest = frames[-1] if frames else self.latest
        self.changed.notify_all()
        return frames

    def wake(self, problem: str | None = None) -> None:
        """Let all who wait look again."""
        with self.changed:
            self.changed.notify_all()
            for tell in self.listeners:
                tell()

    @contextmanager
    def telling(self, listener: Callable[[], None]) -> Iterator[None]:
        """Call listener, while in this context, whenever a frame has come or is overdue."""
        with self.changed:
            self.listeners.add(listener)
        try:
            yield
        finally:
            with self.changed:
                self.listeners.discard(listener)

    def clear(self) -> None:
        """Discard the frames that wait; never between another thread's look and its taking one."""
        with self.changed:
            self.frames.clear()
            self.latest = None

    @contextmanager
    def unbounded(self) -> Iterator[None]:
        """Take any number of frames in the context, so that the driver's lock becomes free."""
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

    contacts, parameters: as those of Skin; port and baud have no effect.

    Raises ParameterError, SpecError and CalibrationError as Skin does.
    """

    def __init__(self, *, contacts: bool = False, **parameters: Setting) -> None:
        config = SkinConfig.of(parameters_of(parameters))
        self._framing = _Framing(config, argument("contacts", contacts, False))
        self._pipeline = Pipeline(config)

    @property
    def layout(self) -> Layout:
        """Tell where the taxels are."""
        return self._pipeline.config.layout

    @property
    def problem(self) -> str | None:
        """Tell why nothing can be decoded now, in one sentence; None while all is well."""
        pipeline = self._pipeline
        if pipeline.problem is None and pipeline.digitizer.info is None:
            counts = pipeline.packet_counts
            return (
                f"no description of a digitizer yet, which sends one every second: "
                f"{counts.packets} packets in {counts.bytes} bytes so far"
            )
        return pipeline.problem

    def feed(self, data: bytes | bytearray | memoryview, t_host: float) -> list[Frame]:
        """Return the frames that bytes complete; t_host: when they were read, monotonic, s."""
        if not math.isfinite(t_host := argument("t_host", t_host, 0.0, unit="s")):
            raise ParameterError(f"t_host is {t_host}; it must be a time in s, as time.monotonic()")
        try:
            view = memoryview(data)
        except TypeError:
            view = None
        if view is None or view.itemsize != 1:
            raise ParameterError(
                f"data is a {type(data).__name__}; it must be bytes of a digitizer"
            )
        return self._shown(self._pipeline.feed(view.tobytes(), t_host))

    def flush(self) -> list[Frame]:
        """Return the frames that still waited for what follows: call it where the bytes end."""
        return self._shown(self._pipeline.flush())

    def _shown(self, frames: Iterable[TactileFrame]) -> list[Frame]:
        return [self._framing.shown(self._framing.find(frame)) for frame in frames]


def read_parameters(path: str | PathLike[str]) -> dict[str, Any]:
    """Read parameters of a ROS 2 parameter file, for `Skin(**read_parameters("skin.yaml"))`.

    Raises ParameterError, naming file and line, for anything else and for wrong values.
    """
    return read_file(path_of("path", path))


def read_recording(path: str | PathLike[str]) -> Iterator[tuple[bytes, float]]:
    """Read bytes of a recording, and when they were read (monotonic, s), for a Decoder.

    Damaged records of a recording are skipped; `tactile-cdma info` counts them. Any other file is
    taken as the bytes of a port, at time 0. Raises CaptureError, when the first bytes are asked
    for, if the file cannot be read.
    """
    return read_bytes(path_of("path", path))


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array, which the decoder goes on using, for a program that only reads it."""
    view = array.view()
    view.flags.writeable = False
    return view
