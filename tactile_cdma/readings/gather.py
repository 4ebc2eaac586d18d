# SPDX-License-Identifier: Apache-2.0

"""Gathers the pressed taxels of a frame into contacts."""

from typing import NamedTuple

import numpy as np

from ..base import kernel
from ..base.arrays import Bools, Floats, Floats32, Indices
from ..places.layout import Layout
from .status import Status
from .taxels import Coverage, Readings

RIM = 0.3
"""Fraction of the release threshold above which taxels adjacent to a contact add to its force.

Without them a soft contact of 6 kPa loses 3 % of its force. With all adjacent taxels, a skin whose
zero is off by one count would add 8 % instead of 5 % (`make bench-contact`).
"""


class Gathered(NamedTuple):
    """The c contacts of a frame and their k taxels, the strongest contact first.

    coverage: how much of the patch was read. goes_on: every taxel in contact was so before, in a
    contact of the same index. taxels: (k,) int, contact by contact, rising within each. places:
    (k,) int, the contact of each in the frame before, −1 for none. bounds: c + 1, where each
    contact begins among these, and where the last ends. moments: (c, 11) float64, sums of load (N),
    load·position (N m), force on the skin (N) and its torque (N m), pressed taxels beside the
    contact included; and the contact's area (m²). pressure_max_pa: (c,) float32. saturated: (c,)
    bool, a taxel is. lower_bound: (c,) bool, a taxel in or beside the contact may carry more than
    it reads: it is saturated, has no reading, or reads less than nothing by as much as a contact is
    more. torn: (c,) bool, one of these had a reading in the frame before and has none, or the other
    way round.
    """

    coverage: Coverage
    goes_on: bool
    taxels: Indices
    places: Indices
    bounds: list[int]
    moments: Floats
    pressure_max_pa: Floats32
    saturated: Bools
    lower_bound: Bools
    torn: Bools


class Gatherer:
    """Gathers frame by frame, in the kernel (kernel/contacts.h).

    It keeps each taxel's contact, and whether it had a reading.
    """

    def __init__(self, layout: Layout) -> None:
        count, library = len(layout), kernel.lib
        self._place, self._notes = np.empty(count, np.int32), np.empty(count, np.uint8)
        self._taxels, self._flags = np.empty((2, count), np.int32), np.empty((3, count), np.bool_)
        self._starts = np.empty(count + 1, np.int32)
        self._tally = np.empty(library.CONTACTS_TALLY, np.int32)
        self._sums = np.empty((count, library.CONTACTS_SUMS))
        self._peak_pa = np.empty(count, np.float32)
        moments = moments_of(layout)
        self._skin = kernel.struct(
            "contacts_skin",
            taxels=count,
            near=layout.neighbours.shape[1],
            neighbours=np.ascontiguousarray(layout.neighbours, dtype=np.int32),
            moments=kernel.pointer(moments, count, library.CONTACTS_MOMENTS),
            contact_pa=0.0,
            release_pa=0.0,
            rim_pa=0.0,
            saturated=Status.SATURATED,
            uncertain=Status.LOW_SNR,
            masked=Status.MASKED,
        )
        self._kept = kernel.struct(
            "contacts_kept",
            place=self._place,
            notes=self._notes,
            scratch=np.empty((library.CONTACTS_SCRATCH, count), np.int32),
            loads=np.empty(count),
        )
        saturated, lower_bound, torn = self._flags
        self._found = kernel.struct(
            "contacts_found",
            taxels=self._taxels[0],
            before=self._taxels[1],
            starts=self._starts,
            tally=self._tally,
            sums=self._sums,
            peak_pa=self._peak_pa,
            saturated=saturated,
            lower_bound=lower_bound,
            torn=torn,
        )
        self.forget()

    def forget(self) -> None:
        """Start over: no taxel was in contact, or had a reading."""
        self._place[:], self._notes[:] = -1, 1

    def gather(self, readings: Readings, contact_pa: float, release_pa: float) -> Gathered:
        """The contacts of a frame, see ContactThresholds; an uncertain reading is none."""
        skin, size = self._skin.at, self._place.size
        skin.contact_pa, skin.release_pa, skin.rim_pa = contact_pa, release_pa, RIM * release_pa
        pressure_pa = kernel.pointer(readings.pressure_pa, size)
        status = kernel.pointer(readings.status, size)
        count = kernel.lib.contacts_gather(skin, pressure_pa, status, self._kept.at, self._found.at)
        if count > size:
            raise ValueError("neighbours: one is no taxel")
        *tally, moved = self._tally.tolist()
        if not count:
            return _NOTHING._replace(coverage=Coverage(*tally))
        bounds = self._starts[: count + 1].tolist()
        taxels, places = self._taxels[:, : bounds[-1]].astype(np.intp)
        sums, peaks_pa = self._sums[:count].copy(), self._peak_pa[:count].copy()
        flags = self._flags[:, :count].copy()
        coverage, goes_on = Coverage(*tally), not moved
        return Gathered(coverage, goes_on, taxels, places, bounds, sums, peaks_pa, *flags)


def moments_of(layout: Layout) -> Floats:
    """(t, 10) float64: load, load·position, force and torque per pascal on each taxel.

    Force and torque against the normal, thus on the skin.
    """
    area = layout.areas_m2.astype(np.float64)[:, None]
    places, inwards = layout.positions_m.astype(np.float64), -layout.normals.astype(np.float64)
    return np.hstack([area, area * places, area * inwards, area * np.cross(places, inwards)])


_NO_TAXELS, _NO_FLAGS = np.zeros(0, dtype=np.intp), np.zeros(0, dtype=bool)
_NOTHING = Gathered(
    *(Coverage(), True, _NO_TAXELS, _NO_TAXELS, [0], np.zeros((0, 11))),
    *(np.zeros(0, dtype=np.float32), _NO_FLAGS, _NO_FLAGS, _NO_FLAGS),
)
