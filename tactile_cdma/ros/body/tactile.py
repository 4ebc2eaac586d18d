# SPDX-License-Identifier: Apache-2.0

"""All taxels of a body in one message, in the body's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.msg import TactileSkinInfo

from ...base.arrays import Floats32
from ...messages.cdr import CdrWriter, Heading, TaxelArray
from ...places.poses import Pose
from ...readings.status import Status
from ..common.convert import places_of

_SEQUENCE = Struct("<Q")
_NOWHERE = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))


class Places:
    """Where the taxels of a patch are, by its info; where they are in the body, by the last pose.

    positions_m: (t, 3) float64, m, in the patch's frame. areas_m2: (t,) float32.
    MessageError: see places_of.
    """

    def __init__(self, info: TactileSkinInfo) -> None:
        self.info_id = info.info_id
        self.positions_m, self._normals, self.areas_m2 = places_of(info)
        self._placed: tuple[Pose, Floats32, Floats32] | None = None

    def __len__(self) -> int:
        return len(self.areas_m2)

    def placed(self, pose: Pose | None) -> tuple[Floats32, Floats32]:
        """Return positions and normals in the body's frame; NaN without a pose."""
        pose = pose or _NOWHERE
        if self._placed is None or self._placed[0] is not pose:
            positions_m = pose.apply(self.positions_m).astype(np.float32)
            normals = pose.rotate(self._normals).astype(np.float32)
            self._placed = pose, positions_m, normals
        return self._placed[1:]


@dataclass(frozen=True, slots=True)
class Part:
    """A patch that was heard. pose: in the body's frame; None: unknown. absent: no present data."""

    name: str
    array: TaxelArray
    places: Places
    pose: Pose | None
    absent: bool


def body_tactile(
    parts: Sequence[Part], absent: Sequence[str], heading: Heading, sequence: int
) -> bytes:
    """Return the message TactileBody. absent: all patches that are, heard ever or not."""
    sizes = [len(part.places) for part in parts]
    readings = [
        (np.full(size, np.nan), np.full(size, Status.STALE))
        if part.absent
        else (part.array.pressure_pa, part.array.status)
        for part, size in zip(parts, sizes, strict=True)
    ]
    placed = [part.places.placed(part.pose) for part in parts]
    writer = CdrWriter()
    writer.header(heading)
    writer.add(_SEQUENCE.pack(sequence), 8)
    writer.texts(absent)
    writer.texts([part.name for part in parts])
    writer.array(np.cumsum([0, *sizes])[:-1].astype("<u4"))
    writer.count(len(parts))
    for part in parts:
        writer.add(part.array.heading.stamp, 4)
    writer.array(_joined([pressure_pa for pressure_pa, _ in readings], (0,)).astype("<f4"))
    writer.array(_joined([status for _, status in readings], (0,)).astype("u1"))
    writer.array(_joined([positions_m for positions_m, _ in placed], (0, 3)).astype("<f4"))
    writer.array(_joined([normals for _, normals in placed], (0, 3)).astype("<f4"))
    writer.array(_joined([part.places.areas_m2 for part in parts], (0,)).astype("<f4"))
    return writer.message


def _joined(arrays: Sequence[NDArray[Any]], empty: tuple[int, ...]) -> NDArray[Any]:
    return np.concatenate(arrays) if arrays else np.zeros(empty)
