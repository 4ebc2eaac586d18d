# SPDX-License-Identifier: Apache-2.0

"""The patches of a body file as one skin, without ROS."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from .base.arrays import Floats32
from .base.errors import PortError, RecordingEndError
from .config.body_file import read_body
from .config.parameters import DEFAULTS, SIMULATION
from .config.python_arguments import argument, path_of, timeout
from .messages.rounds import Rounds
from .places.poses import Pose
from .readings.status import Status
from .skin import LOOK_S, TIMEOUT_S, Frame, Skin

STALE_S = 1.0
"""A patch without a frame for longer, s, and two of its frame periods at least, is missing; chosen
as stale_after_s of the body's node."""
FIRST_S = 2.0
"""Longest wait for all patches before the first frame, s; chosen: a port opens within it."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyFrame:
    """The newest frames of a body's patches, with t taxels together, in the order of its file.

    sequence: counts the body's frames. t_host: when the newest of its patches' was measured, s, on
        the host's monotonic clock; patches have their own, each of its own frame.
    patches: the frames of the patches that are there, by name. missing: the other patches, whose
        touch is unknown.
    pressure_pa: (t,) float32, Pa; NaN where there is no valid reading, and in missing patches.
    status: (t,) uint8, bits of Status; STALE in missing patches.
    parts: which elements are of a patch, by name.
    """

    sequence: int
    t_host: float
    patches: Mapping[str, Frame]
    missing: tuple[str, ...]
    pressure_pa: Floats32
    status: NDArray[np.uint8]
    parts: Mapping[str, slice]

    def __repr__(self) -> str:
        missing = f", missing: {', '.join(self.missing)}" if self.missing else ""
        return f"BodyFrame({self.sequence}: {len(self.patches)} patches there{missing})"


class Body:
    """Frames of many skins, each decoded in a thread of its own, on one clock.

    >>> from tactile_cdma import Body
    >>> with Body("config/body.yaml") as body:
    ...     for frame in body:
    ...         if not frame.missing:  # all patches are there
    ...             print(frame.pressure_pa.shape)
    ...             break
    (249,)

    A frame comes as soon as every patch that is there has delivered one since the last, or one is
    about to deliver its second: so none is skipped.

    path: a body file (docs/patches.md). only: names of patches, separated by commas; all if empty.
    contacts, timeout_s: as of Skin.
    skins: by name; their frames go here, nobody else must read them.
    parts, positions_m: of all taxels, see BodyFrame; positions_m: (t, 3) float32, m, in the body's
        frame, NaN for patches that are mounted on another one.

    BodyError, and what Skin raises, are raised for a file that cannot be used. A port that cannot
    be opened raises nothing: its patch is missing until it can.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        only: str = "",
        contacts: bool = False,
        timeout_s: float | None = TIMEOUT_S,
    ) -> None:
        self.timeout_s, self.path = timeout("timeout_s", timeout_s), path_of("path", path)
        found = read_body(self.path)
        self.skins: dict[str, Skin] = {}
        self.parts: dict[str, slice] = {}
        places, count = [], 0
        for patch in found.only(argument("only", only, "")):
            values = {**DEFAULTS, **patch.values}
            given = {"port": SIMULATION} | {k: v for k, v in patch.values.items() if v != ""}
            skin = Skin(**given, contacts=contacts)  # type: ignore[arg-type]
            self.skins[patch.name] = skin
            self.parts[patch.name] = slice(count, count := count + len(skin.layout))
            pose = Pose.of_rpy(values["mount_xyz_m"], values["mount_rpy_rad"])
            is_known = values["parent_frame"] == found.frame_id
            places.append(
                pose.apply(skin.layout.positions_m.astype(np.float64))
                * (1.0 if is_known else math.nan)
            )
        self.positions_m: Floats32 = np.concatenate(places).astype(np.float32)
        self._end = ExitStack()
        self._news = threading.Event()
        self._begin()

    def __repr__(self) -> str:
        return f"Body({str(self.path)!r}, {len(self.skins)} patches)"

    def open(self) -> Body:
        """Begin to open the ports and to decode; ports that cannot be opened are tried again."""
        self._begin()
        with ExitStack() as opened:
            for skin in self.skins.values():
                opened.callback(skin.close)
                skin.open(patiently=True)
                opened.enter_context(skin.telling(self._news.set))
            self._end = opened.pop_all()
        return self

    def close(self) -> None:
        """Stop the digitizers and close the ports."""
        self._end.close()

    def __enter__(self) -> Body:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[BodyFrame]:
        """Yield every frame in order, until all are recordings that ended; raises as read()."""
        with suppress(RecordingEndError):
            while True:
                yield self.read()

    def read(self) -> BodyFrame:
        """Wait for the next frame.

        Raises PortError after timeout_s without a frame of any patch, with every patch's reason,
        and RecordingEndError where all are recordings that have ended.
        """
        begun_s = time.monotonic()
        while True:
            self._news.clear()
            for name, skin in self.skins.items():
                self._waiting[name].extend(skin.waiting())
            if (frame := self._next(time.monotonic())) is not None:
                return frame
            self._look(begun_s)
            self._news.wait(LOOK_S)

    def _begin(self) -> None:
        slowest_s = max(skin.config.spec.frame_period_s for skin in self.skins.values())
        self._rounds = Rounds(max(STALE_S, 2 * slowest_s))
        self._waiting: dict[str, deque[Frame]] = {name: deque() for name in self.skins}
        self._newest: dict[str, Frame] = {}
        self._begun_s, self._sequence = time.monotonic(), 0

    def _next(self, now_s: float) -> BodyFrame | None:
        """Go on to the end of a round; None if it is not there yet."""
        while waiting := [name for name, frames in self._waiting.items() if frames]:
            name = min(waiting, key=lambda name: self._waiting[name][0].t_host)
            if self._rounds.is_due_before(name) and (frame := self._round(now_s)) is not None:
                return frame
            self._newest[name] = self._waiting[name].popleft()
            if self._rounds.add(name, now_s) and (frame := self._round(now_s)) is not None:
                return frame
        return None

    def _round(self, now_s: float) -> BodyFrame | None:
        """Combine what the patches have delivered; None while a patch may not have begun."""
        self._rounds.end()
        there = set(self._rounds.present(self.skins, now_s))
        missing = tuple(name for name in self.skins if name not in there)
        if missing and not self._sequence and now_s - self._begun_s < FIRST_S:
            return None
        count = len(self.positions_m)
        pressure_pa = np.full(count, np.nan, dtype=np.float32)
        status = np.full(count, Status.STALE, dtype=np.uint8)
        patches = {name: self._newest[name] for name in self.skins if name in there}
        for name, frame in patches.items():
            pressure_pa[self.parts[name]], status[self.parts[name]] = (
                frame.pressure_pa,
                frame.status,
            )
        t_host = max(frame.t_host for frame in patches.values())
        self._sequence += 1
        return BodyFrame(self._sequence, t_host, patches, missing, pressure_pa, status, self.parts)

    def _look(self, begun_s: float) -> None:
        """Raise as read(), which waits since begun_s."""
        text = "; ".join(
            f"{name}: {skin.port}: {skin.silence}" for name, skin in self.skins.items()
        )
        if all(skin.ended for skin in self.skins.values()):
            raise RecordingEndError(f"{self.path}: {text}")
        slowest_s = max(skin.config.spec.frame_period_s for skin in self.skins.values())
        limit_s = math.inf if self.timeout_s is None else max(self.timeout_s, 2 * slowest_s)
        if time.monotonic() - begun_s >= limit_s:
            raise PortError(f"{self.path}: no frame for {limit_s:g} s: {text}")
