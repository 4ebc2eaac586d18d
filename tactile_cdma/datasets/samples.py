# SPDX-License-Identifier: Apache-2.0

"""What every source hands on: constant data of a patch, its frames, samples of other topics."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats32
from ..base.errors import CaptureError
from ..base.text import listed
from ..places.layout import Layout
from ..readings.status import is_certain, is_in_service

CONTACT_NAMES = ("touched", "untouched", "contacts", "area_m2", "x_m", "y_m", "z_m")
"""Elements of a sample of contacts; x, y, z: centre of pressure in the patch's frame."""
WRENCH_NAMES = ("force_x_n", "force_y_n", "force_z_n", "torque_x_nm", "torque_y_nm", "torque_z_nm")
NANO = 1_000_000_000
PUBLISHER = "#"
"""Separates, in the key of a vector's stream, the number of the program that publishes it."""
MOST_SHOWN = 8
"""Taxels, or names, that a message lists; chosen."""


class Kind(StrEnum):
    """What a stream holds."""

    TACTILE = "tactile"
    CONTACTS = "contacts"
    WRENCH = "wrench"
    STATE = "state"
    ACTION = "action"
    IMAGE = "image"
    DEPTH = "depth"


DERIVED = {Kind.CONTACTS: CONTACT_NAMES, Kind.WRENCH: WRENCH_NAMES}
"""What is computed from a patch's frames: the elements of a sample."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchInfo:
    """What is the same in all frames of one skin patch with t taxels.

    name: as features are called, [a-z0-9_]. topic: of its frames; empty for a recording.
    nodes: (t,) uint16, from 1; 0: none. positions_m, normals: (t, 3) float32; areas_m2: (t,)
    float32. All are NaN or 0 where a bag does not hold the patch's info.
    frame_period_s: nominal; NaN if unknown.
    about: file, origin, measured_by, digitizer_id, skin, calibration_id, and what else is known.
    """

    name: str
    topic: str
    rows: int
    columns: int
    nodes: NDArray[np.uint16]
    positions_m: Floats32
    normals: Floats32
    areas_m2: Floats32
    frame_period_s: float
    about: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def layout(self) -> Layout:
        """Return the layout to draw it by; a grid where its places are not known."""
        if not np.isfinite(self.positions_m).all():
            return Layout.grid(len(self), self.rows, self.columns, pitch_m=1e-3, taxel_m=1e-3)
        places = self.positions_m, self.normals, self.areas_m2
        return Layout.seen(self.name, (self.rows, self.columns), self.nodes.astype(int), *places)


@dataclass(frozen=True, slots=True, eq=False)
class SkinFrame:
    """One frame of a patch, as in TactileArray.

    wall_time_s: Unix time of its middle; NaN for raw bytes. device_time_s: the same moment on the
    digitizer's clock. stamp_uncertainty_s: wall_time_s may be off by up to this; NaN like it.
    pressure_pa, voltage_v: (t,) float32, NaN: no valid reading. status: (t,) uint8, bits of Status.
    """

    sequence: int
    device_time_s: float
    wall_time_s: float
    stamp_uncertainty_s: float
    noise_v: float
    pressure_pa: Floats32
    voltage_v: Floats32
    status: NDArray[np.uint8]

    @property
    def valid(self) -> Bools:
        """Return which taxels have a certain reading, (t,)."""
        return np.isfinite(self.pressure_pa) & is_certain(self.status)


@dataclass(frozen=True, slots=True)
class RawImage:
    """A camera's message, as it was recorded: few of them are encoded, see sources.images."""

    message: Any


Value: TypeAlias = SkinFrame | Floats32 | RawImage


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One value of one stream.

    stamp_ns: Unix time at which it was measured, ns. seen_ns: when it was recorded; rises.
    """

    stream: str
    stamp_ns: int
    seen_ns: int
    value: Value


@dataclass(frozen=True, slots=True)
class SampleStream:
    """What is the same in all samples of a stream.

    key: its name, unique. feature: name for datasets, [a-z0-9_]. shape: of a sample; of images
    height, width, 3. names: of a vector's elements. patch: of frames. dtype, unit: of depths.
    """

    key: str
    kind: Kind
    feature: str
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()
    patch: PatchInfo | None = field(default=None, compare=False)
    dtype: str = "float32"
    unit: str = ""

    @property
    def topic(self) -> str:
        """Return the topic that it is made of; its kind for a recording, which has no topics."""
        return self.key.removeprefix(f"{self.kind}:").partition(PUBLISHER)[0]


class SampleSource(Protocol):
    """A recording or a bag.

    streams: by key. begin_ns, end_ns: Unix time of its first and last data, as recorded; the end
    may be unknown (0). problem: why it has no frame, as far as it was read. notes: what was wrong,
    one sentence each, complete when all is read.
    """

    path: Path
    begin_ns: int
    end_ns: int

    @property
    def streams(self) -> Mapping[str, SampleStream]: ...

    @property
    def problem(self) -> str | None: ...

    @property
    def notes(self) -> tuple[str, ...]: ...

    def samples(self, begin_ns: int | None, end_ns: int | None) -> Iterator[Sample]:
        """Yield the streams' samples in the order of seen_ns, from and to times, both included."""
        ...

    def marks(self, topic: str) -> list[tuple[int, Any]]:
        """Return messages of a topic, and when they were recorded, ns. Raises CaptureError."""
        ...


def skin_stream(key: str, kind: Kind, patch: PatchInfo) -> SampleStream:
    """Return the stream of a patch's frames, of its contacts or of its wrench."""
    if kind == Kind.TACTILE:
        return SampleStream(key, kind, patch.name, (len(patch),), patch=patch)
    names = DERIVED[kind]
    return SampleStream(key, kind, patch.name, (len(names),), names)


def patches_of(streams: Mapping[str, SampleStream]) -> dict[str, PatchInfo]:
    """Return the skin patches among streams, by the key of their frames."""
    return {key: stream.patch for key, stream in streams.items() if stream.patch is not None}


def in_order(values: Floats32, its: tuple[str, ...], names: tuple[str, ...]) -> Floats32 | None:
    """Put elements that are called its in the order of names; None if some are missing."""
    return values[[its.index(name) for name in names]] if set(names) <= set(its) else None


def feature_name(text: str) -> str:
    """Return a name that features may have, from a topic's or a skin's."""
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_") or "skin"


class Completeness:
    """Which taxels of a patch have had a valid reading so far.

    A recording begins with unknown taxels: a silent node is known only once it has spoken.

    missing: taxels in service that have had none. is_complete: there was a frame, and none is.
    """

    def __init__(self) -> None:
        self._read: Bools = np.zeros(1, dtype=bool)
        self.missing: list[int] = []
        self.is_complete = False

    def take(self, frame: SkinFrame) -> None:
        if not self.is_complete:
            self._read = self._read | frame.valid
            self.missing = np.flatnonzero(is_in_service(frame.status) & ~self._read).tolist()
            self.is_complete = not self.missing

    @property
    def unread(self) -> str:
        """Name the missing taxels, the first ones of many; "any taxel" before a frame."""
        return listed(self.missing, "taxel", MOST_SHOWN) if self.missing else "any taxel"

    def check(self, path: Path, patch: str) -> None:
        """Raises CaptureError, naming the taxels, where some never had a valid reading."""
        if not self.is_complete:
            raise CaptureError(
                f"{path}: patch {patch} is never complete: no valid reading of "
                f"{self.unread}; mask them, or drop --from-first-complete"
            )


def check_taxels(
    first: PatchInfo, other: PatchInfo, path: Path, where: str = "the first file"
) -> None:
    """Raises CaptureError where a patch's taxels differ from those of the first one.

    path: of the file that holds the other one. where: the first one is.
    """
    remedy = "; export them one by one" if where == "the first file" else ""
    if (mine := (first.rows, first.columns)) != (its := (other.rows, other.columns)):
        raise CaptureError(
            f"{path}: patch {other.name} has {its[0]} × {its[1]} taxels, in {where} "
            f"{mine[0]} × {mine[1]}{remedy}"
        )
    for name in ("nodes", "positions_m", "normals", "areas_m2"):
        if not np.array_equal(getattr(first, name), getattr(other, name), equal_nan=True):
            raise CaptureError(
                f"{path}: {name.partition('_')[0]} of the taxels of patch {other.name} are not "
                f"those in {where}{remedy}"
            )


def differences(
    patch: str, first: Mapping[str, Any], other: Mapping[str, Any], where: str = "the first file"
) -> Iterator[str]:
    """Tell how another file's readings of a patch come from elsewhere than the first's, by about.

    where: the first is.
    """
    for key in ("origin", "measured_by", "calibration_id", "tared"):
        without = False if key == "tared" else "unknown"
        mine, its = (about.get(key, without) for about in (first, other))
        if mine != its:
            yield f"{key} of patch {patch} is {its!r}, in {where} {mine!r}"


class Continuity:
    """Counts what is missing between frames that follow each other, by their sequence.

    missing: frame periods without a frame. gaps, restarts: where some are missing; where the
    sequence begins anew, as after a driver's restart. length_s: from the first frame to the last.
    """

    def __init__(self) -> None:
        self.missing, self.length_s = 0, 0.0
        self.gaps, self.restarts = Pauses(), Pauses()
        self._last: tuple[int, float] | None = None  # sequence, time

    def take(self, sequence: int, time_s: float, follows: bool = True) -> None:
        """Take a frame. follows: what lies between it and the one before counts."""
        if self._last is not None and follows:
            before, pause_s = self._last[0], time_s - self._last[1]
            if sequence <= before:
                self.restarts.take(pause_s, self.length_s)
            elif missing := sequence - before - 1:
                self.missing += missing
                self.gaps.take(pause_s, self.length_s)
            self.length_s += pause_s
        self._last = sequence, time_s


class Pauses:
    """Intervals between two frames: their number, all of them together, s, and the longest."""

    def __init__(self) -> None:
        self.number, self.total_s = 0, 0.0
        self._longest = (-math.inf, 0.0)  # s, and s after which it begins

    def take(self, length_s: float, at_s: float) -> None:
        self.number, self.total_s = self.number + 1, self.total_s + length_s
        self._longest = max(self._longest, (length_s, at_s), key=lambda pause: pause[0])

    @property
    def longest(self) -> str:
        length_s, at_s = self._longest
        return f"the longest {length_s:.3f} s after {at_s:.3f} s"
