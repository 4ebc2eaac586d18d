# SPDX-License-Identifier: Apache-2.0

"""Contacts on the skin: gathered from its taxels, and tracked from frame to frame."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..base import kernel
from ..base.arrays import Bools, Floats, Floats32, Indices, Int64s
from ..base.errors import ParameterError, SpecError
from ..places.layout import Layout
from .status import Status
from .taxels import Coverage, Readings

SMOOTHING_S = 0.05
"""Time constant of velocities and force rates, s; chosen: 4 frames of the paper's skin."""
RIM = 0.3
"""Fraction of the release threshold above which taxels adjacent to a contact add to its force.
Without them a soft contact of 6 kPa loses 3 % of its force. With all adjacent taxels, a skin whose
zero is off by one count would add 8 % instead of 5 % (`make bench-contact`)."""


@dataclass(frozen=True, slots=True)
class ContactThresholds:
    """Thresholds in Pa: a contact begins where a taxel exceeds contact_pa.

    It includes the taxels above release_pa that are connected to that one, and lasts until none of
    its taxels is above release_pa.

    Raises SpecError if release_pa is above contact_pa.
    """

    contact_pa: float
    release_pa: float

    def __post_init__(self) -> None:
        if self.release_pa > self.contact_pa:
            raise SpecError(
                f"release_kpa is {self.release_pa / 1e3:g} kPa, above contact_kpa, which is "
                f"{self.contact_pa / 1e3:g} kPa: contacts would end before they begin"
            )


@dataclass(frozen=True, eq=False, slots=True)
class Contact:
    """One contact, with the names and units of TactileContact.msg.

    patch: the patch of a Body that it is on; empty for a Skin. id: the same while it lasts. age: s
    since it began. position (m), normal, force (N), velocity (m/s): (3,) float64. area: m².
    pressure_max: Pa. force_rate: N/s. saturated, lower_bound, taxels: see Contacts.
    """

    patch: str
    id: int
    age: float
    position: Floats
    normal: Floats
    force: Floats
    area: float
    pressure_max: float
    saturated: bool
    lower_bound: bool
    velocity: Floats
    force_rate: float
    taxels: Indices


@dataclass(frozen=True, eq=False, slots=True)
class Contacts:
    """The contacts of one frame, c of them, the strongest first; `contacts` has them one by one.

    coverage: how much of the patch was read. ids: (c,) int64, from 1 on.
    age_s: (c,) float64, s since each began. moments: (c, 11) float64, see Gathered.
    course: (c, 8) float64, position (m), force (N), and velocity (m/s) and force rate (N/s),
        smoothed. normals: (c, 3) float64, unit vectors out of the skin, the taxels' normals
        weighted by their forces. pressure_max_pa: (c,) float32.
    saturated: (c,) bool, a taxel is beyond its range.
    lower_bound: (c,) bool, force, area and pressure are at least this: a taxel in or beside the
        contact may carry more than it reads, or has no certain reading.
    taxels: per contact the indices of its taxels, rising. patches: the patch of each, of a Body.

    The columns of moments are sums over taxels, in one array that the kernel fills; those of course
    are what is smoothed together. Messages hold neither, so their layout (ros/common/touches.py) is
    another.
    """

    coverage: Coverage
    ids: Int64s
    age_s: Floats
    moments: Floats
    course: Floats
    normals: Floats
    pressure_max_pa: Floats32
    saturated: Bools
    lower_bound: Bools
    taxels: list[Indices]
    patches: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        loads = ", ".join(f"{load_n:.2f} N" for load_n in self.load_n)
        read = f"{self.coverage.valid} of {self.coverage.in_service} taxels valid"
        return f"Contacts([{loads}], {read})"

    @property
    def contacts(self) -> list[Contact]:
        """Return the contacts, the strongest first."""
        columns = (
            *(self.patches or ("",) * len(self), self.ids.tolist(), self.age_s.tolist()),
            *(self.position_m, self.normals, self.force_n, self.area_m2.tolist()),
            *(self.pressure_max_pa.tolist(), self.saturated.tolist(), self.lower_bound.tolist()),
            *(self.velocity_m_s, self.force_rate_n_s.tolist(), self.taxels),
        )
        return [Contact(*one) for one in zip(*columns, strict=True)]

    @property
    def taxels_valid(self) -> int:
        """Count the taxels in service that have a valid, certain reading."""
        return self.coverage.valid

    @property
    def taxels_in_service(self) -> int:
        """Count the taxels with a node that the layout does not mask."""
        return self.coverage.in_service

    @property
    def touched(self) -> bool:
        """Tell whether there is a contact, by certain readings."""
        return len(self) > 0

    @property
    def load_n(self) -> Floats:
        """Return the load Σ p·A, (c,), N."""
        return self.moments[:, 0]

    @property
    def position_m(self) -> Floats:
        """Return (c, 3) centre of pressure Σ r·p·A / Σ p·A, m."""
        return self.course[:, :3]

    @property
    def force_n(self) -> Floats:
        """Return (c, 3) force on the skin, Σ −normal·p·A, N."""
        return self.moments[:, 4:7]

    @property
    def torque_nm(self) -> Floats:
        """Return the torque of these forces about the frame's origin, (c, 3), N·m."""
        return self.moments[:, 7:10]

    @property
    def area_m2(self) -> Floats:
        """Return the area of the taxels in contact, (c,), m²."""
        return self.moments[:, 10]

    @property
    def velocity_m_s(self) -> Floats:
        """Return the speed of the position along the skin, (c, 3), smoothed, m/s."""
        return self.course[:, 4:7]

    @property
    def force_rate_n_s(self) -> Floats:
        """Return (c,) rate of change of the force, smoothed, N/s."""
        return self.course[:, 7]

    @property
    def untouched(self) -> bool:
        """Tell whether nothing touches the patch: no contact, and all taxels surely read none."""
        return not len(self) and self.coverage.is_certain

    @property
    def has_resultant(self) -> bool:
        """Tell whether the sums over all contacts mean anything.

        A sum of 0 is a claim about every taxel, one of contacts about those that were read: at
        least half of them have to be, see Coverage.is_most.
        """
        return self.untouched or (self.touched and self.coverage.is_most)

    @property
    def resultant(self) -> Floats:
        """Sum up all contacts: (10,) area (m²), centre (m), force (N), torque (N m)."""
        if not self.touched or not self.has_resultant:
            return _NOTHING if self.untouched else _UNKNOWN
        total = self.moments.sum(axis=0)
        total[1:4] /= total[0]
        total[0] = total[10]
        return np.asarray(total[:10])

    @property
    def total_area_m2(self) -> float:
        """Return the area in contact, m²; NaN where has_resultant is False, as the following."""
        return float(self.resultant[0])

    @property
    def total_force_n(self) -> Floats:
        """Return (3,) resultant force on the skin, N."""
        return self.resultant[4:7]

    @property
    def total_torque_nm(self) -> Floats:
        """Return the torque of that force about the frame's origin, (3,), N·m."""
        return self.resultant[7:]

    @property
    def wrench(self) -> Floats:
        """Return total force and torque, (6,), N and N·m."""
        return self.resultant[4:]

    @property
    def centre_m(self) -> Floats:
        """Return (3,) centre of pressure of all contacts, m; NaN if there are none, too."""
        return self.resultant[1:4]


def wrench_covariance(
    layout: Layout, contacts: Contacts, pressure_pa: Floats32, sigma_pa: Floats32, release_pa: float
) -> Floats:
    """Return the covariance of force, N, and torque, N m, of all contacts: (6, 6).

    pressure_pa, sigma_pa: (t,), Pa. release_pa: as ContactThresholds; the same taxels count. NaN
    where the wrench, or how sure a taxel of it is, is unknown.
    """
    if not contacts.has_resultant:
        return np.full((6, 6), np.nan)
    counts = np.zeros(len(layout), dtype=bool)
    for taxels in contacts.taxels:
        counts[layout.neighbours[taxels]] = True
    counts &= pressure_pa > RIM * release_pa  # those beside a contact
    counts[[taxel for taxels in contacts.taxels for taxel in taxels]] = True
    forces = moments_of(layout)[counts, 4:] * sigma_pa[counts, None].astype(np.float64)
    return np.asarray(forces.T @ forces)


class Felt:
    """What a frame of a Skin, or a Body, tells of its contacts."""

    __slots__ = ()
    contacts: Contacts | None

    @property
    def touched(self) -> bool:
        """Tell whether a contact is certain; False does not say that there is none.

        Raises ParameterError, as the following, unless contacts were asked for.
        """
        return self._found.touched

    @property
    def untouched(self) -> bool:
        """Tell whether nothing touches the skin, and all taxels surely say so."""
        return self._found.untouched

    @property
    def wrench(self) -> Floats:
        """Return force, N, and torque about the frame's origin, N·m, (6,); NaN: unknown."""
        return self._found.wrench

    @property
    def _found(self) -> Contacts:
        if self.contacts is None:
            raise ParameterError("contacts are found only with contacts=True")
        return self.contacts


_UNKNOWN = np.full(10, np.nan)
_NOTHING = np.array([0.0, *[math.nan] * 3, *[0.0] * 6])
for _constant in (_UNKNOWN, _NOTHING):
    _constant.flags.writeable = False
_NONE, _NO_TAXELS, _NO_FLAGS = np.zeros(0), np.zeros(0, np.intp), np.zeros(0, np.bool_)
NO_CONTACTS = Contacts(
    *(Coverage(), _NONE.astype(np.int64), _NONE, np.zeros((0, 11)), np.zeros((0, 8))),
    *(np.zeros((0, 3)), _NONE.astype(np.float32), _NO_FLAGS, _NO_FLAGS, []),
)


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
        found = {
            "starts": np.empty(count + 1, np.int32),
            "tally": np.empty(library.CONTACTS_TALLY, np.int32),
            "sums": np.empty((count, library.CONTACTS_SUMS)),
            "peak_pa": np.empty(count, np.float32),
        }
        self._starts, self._tally, self._sums, self._peak_pa = found.values()
        found |= zip(("taxels", "before"), self._taxels, strict=True)
        found |= zip(("saturated", "lower_bound", "torn"), self._flags, strict=True)
        self._found = kernel.struct("contacts_found", **found)
        self._skin = kernel.struct(
            "contacts_skin",
            taxels=count,
            near=layout.neighbours.shape[1],
            neighbours=np.ascontiguousarray(layout.neighbours, dtype=np.int32),
            moments=kernel.pointer(moments_of(layout), count, library.CONTACTS_MOMENTS),
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
            return _NO_GATHERED._replace(coverage=Coverage(*tally))
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


_NO_GATHERED = Gathered(
    *(Coverage(), True, _NO_TAXELS, _NO_TAXELS, [0], np.zeros((0, 11))),
    *(_NONE.astype(np.float32), _NO_FLAGS, _NO_FLAGS, _NO_FLAGS),
)


class ContactTracker:
    """Finds the contacts of every frame and matches them with those of the frame before.

    A contact keeps its id as long as it shares taxels with itself in the frame before. Where
    contacts merge or split, the id follows the largest number of shared taxels; the others end, or
    begin with new ids, and no id is used twice. The jumps of position that this causes do not count
    as motion, nor do those where a taxel loses its reading or gets one. An uncertain reading counts
    as none: of contacts nothing is reported that might have ended unheard.

    thresholds may be replaced at any time, from other threads too.
    """

    def __init__(self, layout: Layout, thresholds: ContactThresholds, first_id: int = 1) -> None:
        self.thresholds = thresholds
        self.next_id = first_id
        self._gatherer = Gatherer(layout)
        self._contacts = NO_CONTACTS
        self._readings: Readings | None = None
        self._used = thresholds
        self._t_s = math.nan

    def forget(self) -> None:
        """Start over: all contacts of the next frame are new."""
        self._contacts = NO_CONTACTS
        self._readings, self._t_s = None, math.nan
        self._gatherer.forget()

    def update(self, readings: Readings, t_s: float) -> Contacts:
        """Return the contacts of the frame at device time t_s, s."""
        if t_s < self._t_s:  # the device's clock was reset
            self.forget()
        passed_s, self._t_s = t_s - self._t_s, t_s
        if readings is not self._readings or self.thresholds is not self._used:
            self._readings, self._used = readings, self.thresholds
            self._contacts = self._find(readings, passed_s)
        elif len(last := self._contacts):  # no reading changed
            course = last.course.copy()
            course[:, 4:] *= _decay(passed_s)
            self._contacts = replace(last, age_s=last.age_s + passed_s, course=course)
        return self._contacts

    def _find(self, readings: Readings, passed_s: float) -> Contacts:
        last, used = self._contacts, self._used
        found = self._gatherer.gather(readings, used.contact_pa, used.release_pa)
        bounds, moments, torn = found.bounds, found.moments, found.torn
        if not (count := len(moments)):
            is_same = not len(last) and found.coverage == last.coverage
            return last if is_same else replace(NO_CONTACTS, coverage=found.coverage)
        ids, age_s, then = last.ids, last.age_s + passed_s, last.course
        if not found.goes_on or len(last) != count:  # else, in most frames, all stay what they are
            labels = np.arange(count).repeat(np.diff(bounds))
            origin, jumped = _origins(found.places, labels, len(last), count)
            new, torn = (origin < 0).nonzero()[0], torn | jumped
            # The last ones are of new contacts, whose origin is −1; their force rises from zero.
            ids, age_s = np.append(ids, 0)[origin], np.append(age_s, 0.0)[origin]
            then = np.concatenate([then, _NO_MOTION])[origin]
            then[new, :3] = moments[new, 1:4] / moments[new, :1]
            ids[new] = np.arange(self.next_id, self.next_id + len(new))
            self.next_id += len(new)
        course, normals = _course(moments, then, torn, passed_s)
        return Contacts(
            *(found.coverage, ids, age_s, moments, course, normals),
            *(found.pressure_max_pa, found.saturated, found.lower_bound),
            taxels=[found.taxels[a:b] for a, b in pairwise(bounds)],
        )


def _origins(places: Indices, labels: Indices, before: int, count: int) -> tuple[Indices, Bools]:
    """Match the present contacts with those of the frame before.

    places: (k,) index of every touched taxel's contact in the frame before, which had `before` of
    them; −1: none. labels: (k,) index of its contact now, of `count`. Returns (count,) indices of
    earlier contacts, −1 for new ones, and (count,) bool, where contacts merged or split.
    """
    torn = np.zeros(count, dtype=bool)
    held = places >= 0
    pairs = np.sort(labels[held] * before + places[held])
    if not len(pairs):
        return np.full(count, -1), torn
    edges = np.concatenate([[True], pairs[1:] > pairs[:-1], [True]]).nonzero()[0]
    shared = edges[1:] - edges[:-1]
    new, old = np.divmod(pairs[edges[:-1]], before)
    torn[new] = (np.bincount(new)[new] > 1) | (np.bincount(old)[old] > 1)
    origin, taken, order = [-1] * count, set(), np.argsort(-shared, kind="stable")
    for heir, ancestor in zip(new[order].tolist(), old[order].tolist(), strict=True):
        if origin[heir] < 0 and ancestor not in taken:
            origin[heir] = ancestor
            taken.add(ancestor)
    return np.array(origin), torn


def _course(moments: Floats, then: Floats, torn: Bools, passed_s: float) -> tuple[Floats, Floats]:
    """Return the course, (c, 8), and normals, (c, 3), of contacts, see Contacts.

    Rates are low-pass filtered differences of frames. then: (c, 8), the course in the frame before.
    torn: (c,) bool, contacts that jumped without moving keep their rates.
    """
    now = np.empty_like(then)
    np.divide(moments[:, 1:4], moments[:, :1], out=now[:, :3])
    forces_n = moments[:, 4:7]
    # At least the smallest float, to be divided by.
    lengths = np.maximum(np.sqrt(np.einsum("ij,ij->i", forces_n, forces_n)), _TINY)[:, None]
    now[:, 3:4], now[:, 4:] = lengths, then[:, 4:]
    normals = forces_n / -lengths
    if passed_s > 0:  # NaN in the very first frame
        change, gain = now[:, 4:], (1.0 - _decay(passed_s)) * ~torn[:, None]
        change += gain * ((now[:, :4] - then[:, :4]) / passed_s - change)
        velocity = change[:, :3]
        velocity -= np.einsum("ij,ij->i", velocity, normals)[:, None] * normals
    return now, normals


def _decay(passed_s: float) -> float:
    """Remaining fraction of a smoothed value after passed_s."""
    return math.exp(-passed_s / SMOOTHING_S)


_TINY = np.finfo(np.float64).tiny
_NO_MOTION = np.zeros((1, 8))
