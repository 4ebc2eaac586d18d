# SPDX-License-Identifier: Apache-2.0

"""The patches of a body file as one skin, without ROS."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from .base.arrays import Floats32
from .base.errors import PortError, RecordingEndError
from .config.body_file import STALE_LIMITS_S, read_body
from .config.parameters import DEFAULTS, SIMULATION
from .config.python_arguments import argument, path_of, timeout
from .messages.rounds import Rounds
from .places.poses import Pose
from .readings.contact import NO_CONTACTS, Contacts, Felt
from .readings.status import Status
from .readings.taxels import Coverage
from .skin import LOOK_S, TIMEOUT_S, Frame, Skin

FIRST_S = 2.0
"""Longest wait for all patches before the first frame, s; chosen: a port opens within it."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyFrame(Felt):
    """The newest frames of a body's patches, with t taxels together, in the order of its file.

    sequence: counts the body's frames. t_host: s, on the host's monotonic clock, when the newest
        of its patches' frames was measured; each of patches has its own.
    patches: the frames of the patches that are there, by name. missing: the other patches, whose
        touch is unknown.
    pressure_pa: (t,) float32, Pa; NaN where there is no valid reading, and in missing patches.
    status: (t,) uint8, bits of Status; STALE in missing patches.
    parts: which elements are of a patch, by name.
    contacts: those of all patches in the body's frame, as of one skin, in which the taxels of a
        missing patch are in service, and not valid; places of patches that are mounted on another
        frame are NaN. None unless contacts=True was asked for.
    """

    sequence: int
    t_host: float
    patches: Mapping[str, Frame]
    missing: tuple[str, ...]
    pressure_pa: Floats32
    status: NDArray[np.uint8]
    parts: Mapping[str, slice]
    contacts: Contacts | None

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
    about to deliver its second: so none is skipped. A patch whose newest frame is older than
    stale_after_s, and two frame periods, is missing; where all are, a frame says so as often.

    path: a body file (docs/patches.md). only: names of patches, separated by commas; all if empty.
    contacts, timeout_s: as of Skin. stale_after_s: that of the body file, unless it is given.
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
        stale_after_s: float | None = None,
    ) -> None:
        self.timeout_s, self.path = timeout("timeout_s", timeout_s), path_of("path", path)
        found = read_body(self.path)
        self.stale_after_s = found.stale_after_s
        if stale_after_s is not None:
            self.stale_after_s = argument("stale_after_s", stale_after_s, 0.0, STALE_LIMITS_S, "s")
        self._contacts, self._poses = contacts, dict[str, Pose]()
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
            if values["parent_frame"] != found.frame_id:  # where it is, only a URDF knows
                pose = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
            self._poses[patch.name] = pose
            places.append(pose.apply(skin.layout.positions_m.astype(np.float64)))
        self.positions_m: Floats32 = np.concatenate(places).astype(np.float32)
        self._end, self._all_silent = ExitStack(), False
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
        if not self._all_silent:
            self._heard_s = time.monotonic()
        while True:
            self._news.clear()
            for name, skin in self.skins.items():
                if frames := skin.waiting():
                    self._waiting[name].extend(frames)
                    self._heard_s, self._all_silent = time.monotonic(), False
            if (frame := self._next(time.monotonic())) is not None:
                return frame
            self._look()
            if self._sequence and time.monotonic() - self._told_s > self._rounds.silent_after_s:
                self._all_silent = True
                if (frame := self._round(time.monotonic())) is not None:
                    return frame
            self._news.wait(LOOK_S)

    def _begin(self) -> None:
        slowest_s = max(skin.config.spec.frame_period_s for skin in self.skins.values())
        self._rounds = Rounds(max(self.stale_after_s, 2 * slowest_s))
        self._waiting: dict[str, deque[Frame]] = {name: deque() for name in self.skins}
        self._newest: dict[str, Frame] = {}
        self._begun_s, self._sequence = time.monotonic(), 0
        # When a patch was heard, or read() began to wait for one; when the last frame was returned.
        self._heard_s = self._told_s = self._begun_s
        self._all_silent = False

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
        there = {name for name in self._rounds.present(self.skins, now_s) if self._is_of_now(name)}
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
        t_host = max(frame.t_host for frame in self._newest.values())
        self._sequence, self._told_s = self._sequence + 1, now_s
        found = self._together(patches) if self._contacts else None
        taxels = pressure_pa, status, self.parts
        return BodyFrame(self._sequence, t_host, patches, missing, *taxels, found)

    def _is_of_now(self, name: str) -> bool:
        """Tell whether a patch's newest frame is as new as the body's, as far as stamps tell.

        Where they do not, as in the first second and of stepped simulations, its arrival does.
        """
        frame, newest = self._newest[name], max(self._newest.values(), key=lambda f: f.t_host)
        slack_s = frame.stamp_uncertainty_s + newest.stamp_uncertainty_s
        is_new = newest.t_host - frame.t_host <= self._rounds.silent_after_s + slack_s
        return is_new or self.skins[name].source.recorded

    def _together(self, patches: Mapping[str, Frame]) -> Contacts:
        """Combine the contacts of the patches that are there in the body's frame."""
        found = [(name, c) for name, f in patches.items() if (c := f.contacts) is not None]
        parts = [NO_CONTACTS]
        for name, contacts in found:
            pose, moments = self._poses[name], contacts.moments.copy()
            course = contacts.course.copy()
            course[:, :3], course[:, 4:7] = pose.apply(course[:, :3]), pose.rotate(course[:, 4:7])
            for vectors in (moments[:, 1:4], moments[:, 4:7], moments[:, 7:10]):
                vectors[:] = pose.rotate(vectors)
            moments[:, 1:4] += moments[:, :1] * pose.translation_m
            moments[:, 7:10] += np.cross(pose.translation_m, moments[:, 4:7])
            normals = pose.rotate(contacts.normals)
            parts.append(replace(contacts, moments=moments, course=course, normals=normals))
        joined = {
            key: np.concatenate([getattr(part, key) for part in parts]) for key in _CONTACT_ARRAYS
        }
        order = np.argsort(-joined["moments"][:, 0], kind="stable")
        names = [name for name, contacts in found for _ in contacts.taxels]
        taxels = [some for part in parts for some in part.taxels]
        unread = sum(_in_service(skin) for name, skin in self.skins.items() if name not in patches)
        seen = [part.coverage for part in parts]
        coverage = Coverage(
            valid=sum(each.valid for each in seen),
            in_service=sum(each.in_service for each in seen) + unread,
            doubtful=sum(each.doubtful for each in seen),
        )
        return Contacts(
            coverage=coverage,
            taxels=[taxels[i] for i in order],
            patches=tuple(names[i] for i in order),
            **{key: array[order] for key, array in joined.items()},
        )

    def _look(self) -> None:
        """Raise as read()."""
        text = "; ".join(
            f"{name}: {skin.port}: {skin.silence}" for name, skin in self.skins.items()
        )
        if all(skin.ended for skin in self.skins.values()):
            raise RecordingEndError(f"{self.path}: {text}")
        slowest_s = max(skin.config.spec.frame_period_s for skin in self.skins.values())
        limit_s = math.inf if self.timeout_s is None else max(self.timeout_s, 2 * slowest_s)
        if time.monotonic() - self._heard_s >= limit_s:
            self._all_silent = False
            raise PortError(f"{self.path}: no frame for {limit_s:g} s: {text}")


def _in_service(skin: Skin) -> int:
    """Count the taxels of a skin with a node that its layout does not mask."""
    nodes = skin.layout.nodes
    return int(np.count_nonzero((nodes > 0) & ~np.isin(nodes, skin.layout.masked)))


_CONTACT_ARRAYS = (
    *("ids", "age_s", "moments", "course", "normals", "pressure_max_pa", "saturated"),
    "lower_bound",
)
