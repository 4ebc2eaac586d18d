# SPDX-License-Identifier: Apache-2.0

"""Contacts on the skin: their forces and positions, tracked from frame to frame."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats, Floats32, Indices
from ..base.errors import SpecError
from ..places.layout import Layout
from .gather import Gatherer
from .status import is_certain
from .taxels import Coverage, Readings

SMOOTHING_S = 0.05
"""Time constant of velocities and force rates, s; chosen: 4 frames of the paper's skin."""


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
class Contacts:
    """The contacts of one frame, c of them, the strongest first.

    coverage: how much of the patch was read.
    ids: (c,) int64, from 1 on. age_s: (c,) float64, s since each began.
    load_n: (c,) float64, Σ p·A, N. position_m: (c, 3) float64, centre of pressure Σ r·p·A / Σ p·A.
    force_n: (c, 3) float64, force on the skin, Σ −normal·p·A, N.
    torque_nm: (c, 3) float64, of these forces about the frame's origin, N·m.
    area_m2: (c,) float64, of the taxels in contact. pressure_max_pa: (c,) float32.
    saturated: (c,) bool, a taxel is beyond its range.
    lower_bound: (c,) bool, force, area and pressure are at least this: a taxel in or beside the
        contact may carry more than it reads, or has no certain reading.
    velocity_m_s: (c, 3) float64, of the position along the skin, smoothed.
    force_rate_n_s: (c,) float64, rate of change of the force, smoothed.
    taxels: per contact the indices of its taxels, rising.
    """

    coverage: Coverage
    ids: NDArray[np.int64]
    age_s: Floats
    load_n: Floats
    position_m: Floats
    force_n: Floats
    torque_nm: Floats
    area_m2: Floats
    pressure_max_pa: Floats32
    saturated: Bools
    lower_bound: Bools
    velocity_m_s: Floats
    force_rate_n_s: Floats
    taxels: list[Indices]

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        loads = ", ".join(f"{load_n:.2f} N" for load_n in self.load_n)
        read = f"{self.coverage.valid} of {self.coverage.in_service} taxels valid"
        return f"Contacts([{loads}], {read})"

    @property
    def touched(self) -> bool:
        """Whether there is a contact, by certain readings."""
        return len(self) > 0

    @property
    def normals(self) -> Floats:
        """(c, 3) unit vectors out of the skin, the taxels' normals weighted by their forces."""
        return -self.force_n / _length(self.force_n)[:, None]

    @property
    def untouched(self) -> bool:
        """Whether nothing touches the patch: no contact, and all taxels surely read none."""
        return not len(self) and self.coverage.is_certain

    @property
    def has_resultant(self) -> bool:
        """Whether the sums over all contacts mean anything.

        A sum of 0 is a claim about every taxel, one of contacts about those that were read: at
        least half of them have to be, see Coverage.is_most.
        """
        return self.untouched or (self.touched and self.coverage.is_most)

    @property
    def total_area_m2(self) -> float:
        """Area in contact, m²; NaN where has_resultant is False, as are the following."""
        return float(self._sum(self.area_m2))

    @property
    def total_force_n(self) -> Floats:
        """(3,) resultant force on the skin, N."""
        return self._sum(self.force_n)

    @property
    def total_torque_nm(self) -> Floats:
        """(3,) its torque about the frame's origin, N·m."""
        return self._sum(self.torque_nm)

    @property
    def wrench(self) -> Floats:
        """(6,) both, N and N·m."""
        return np.concatenate([self.total_force_n, self.total_torque_nm])

    @property
    def centre_m(self) -> Floats:
        """(3,) centre of pressure of all contacts, m; NaN if there are none, too."""
        if not len(self) or not self.has_resultant:
            return np.full(3, np.nan)
        return np.asarray(self.load_n @ self.position_m / self.load_n.sum())

    def _sum(self, of_contacts: Floats) -> Floats:
        total = of_contacts.sum(axis=0)
        return np.asarray(total if self.has_resultant else np.full_like(total, np.nan))


_NO_READING = np.float32(np.nan)
_NONE, _NOWHERE = np.zeros(0), np.zeros((0, 3))
_NO_IDS, _NO_PEAKS, _NO_FLAGS = _NONE.astype(np.int64), _NONE.astype(np.float32), _NONE.astype(bool)
NO_CONTACTS = Contacts(
    *(Coverage(), _NO_IDS, _NONE, _NONE, _NOWHERE, _NOWHERE, _NOWHERE, _NONE),
    *(_NO_PEAKS, _NO_FLAGS, _NO_FLAGS, _NOWHERE, _NONE, []),
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
        self._contacts, self._course = NO_CONTACTS, _NO_COURSE
        self._readings: Readings | None = None
        self._used = thresholds
        self._t_s = math.nan

    def forget(self) -> None:
        """Start over: all contacts of the next frame are new."""
        self._contacts, self._course = NO_CONTACTS, _NO_COURSE
        self._readings, self._t_s = None, math.nan
        self._gatherer.forget()

    def update(self, readings: Readings, t_s: float) -> Contacts:
        """The contacts of the frame at device time t_s, s."""
        if t_s < self._t_s:  # the device's clock was reset
            self.forget()
        passed_s, self._t_s = t_s - self._t_s, t_s
        if readings is self._readings and self.thresholds is self._used:
            self._rest(passed_s)
        else:
            self._readings, self._used = readings, self.thresholds
            self._contacts = self._find(readings, passed_s)
        return self._contacts

    def _find(self, readings: Readings, passed_s: float) -> Contacts:
        coverage, last = readings.coverage(self._used.contact_pa), self._contacts
        if not coverage.is_whole:
            certain_pa = np.where(is_certain(readings.status), readings.pressure_pa, _NO_READING)
            readings = replace(readings, pressure_pa=certain_pa)
        found = self._gatherer.gather(readings, self._used.contact_pa, self._used.release_pa)
        count = len(found.starts)
        if not count:
            self._course = _NO_COURSE
            is_same = not len(last) and coverage == last.coverage
            return last if is_same else replace(NO_CONTACTS, coverage=coverage)
        begins = found.starts.tolist()
        ends = [*begins[1:], len(found.taxels)]
        ids, age_s, then, torn = last.ids, last.age_s + passed_s, self._course, found.torn
        sums = found.moments
        position_m, force_n = sums[:, 1:4] / sums[:, :1], -sums[:, 4:7]
        labels = np.arange(count).repeat(np.subtract(ends, begins))
        goes_on = len(last) == count and np.array_equal(found.places, labels)
        if not goes_on:  # as it does in most frames
            origin, jumped = _origins(found.places, labels, len(last), count)
            new, torn = (origin < 0).nonzero()[0], torn | jumped
            # The last ones are of new contacts, whose origin is −1; their force rises from zero.
            ids, age_s = np.append(ids, 0)[origin], np.append(age_s, 0.0)[origin]
            then = np.concatenate([then, _NO_MOTION])[origin]
            then[new, :3] = position_m[new]
            ids[new] = np.arange(self.next_id, self.next_id + len(new))
            self.next_id += len(new)
        self._course = course = _course(position_m, force_n, then, torn, passed_s)
        return Contacts(
            coverage=coverage,
            ids=ids,
            age_s=age_s,
            load_n=sums[:, 0],
            position_m=position_m,
            force_n=force_n,
            torque_nm=-sums[:, 7:10],
            area_m2=found.area_m2,
            pressure_max_pa=found.pressure_max_pa,
            saturated=found.saturated,
            lower_bound=found.lower_bound,
            velocity_m_s=course[:, 4:7],
            force_rate_n_s=course[:, 7],
            taxels=[found.taxels[a:b] for a, b in zip(begins, ends, strict=True)],
        )

    def _rest(self, passed_s: float) -> None:
        """Go on with the same contacts after passed_s in which no reading changed."""
        if not len(self._contacts):
            return
        self._course = course = self._course.copy()
        course[:, 4:] *= _decay(passed_s)
        self._contacts = replace(
            self._contacts,
            age_s=self._contacts.age_s + passed_s,
            velocity_m_s=course[:, 4:7],
            force_rate_n_s=course[:, 7],
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


def _course(
    position_m: Floats, force_n: Floats, then: Floats, torn: Bools, passed_s: float
) -> Floats:
    """(c, 8) position, m, force, N, velocity, m/s, and force rate, N/s, of every contact.

    The latter are low-pass filtered differences of frames. then: (c, 8), those of the frame before.
    torn: (c,) bool, contacts that jumped without moving keep their rates.
    """
    now, force = np.empty_like(then), _length(force_n)[:, None]
    now[:, :3], now[:, 3:4], now[:, 4:] = position_m, force, then[:, 4:]
    if passed_s > 0:  # NaN in the very first frame
        change, normals = now[:, 4:], force_n / force
        gain = (1.0 - _decay(passed_s)) * ~torn[:, None]
        change += gain * ((now[:, :4] - then[:, :4]) / passed_s - change)
        change[:, :3] -= (change[:, :3] * normals).sum(axis=1, keepdims=True) * normals
    return now


def _decay(passed_s: float) -> float:
    """Remaining fraction of a smoothed value after passed_s."""
    return math.exp(-passed_s / SMOOTHING_S)


def _length(vectors: Floats) -> Floats:
    """Lengths (c,) of vectors (c, 3), at least the smallest float, to be divided by."""
    return np.asarray(np.maximum(np.sqrt(np.square(vectors).sum(axis=1)), _TINY))


_TINY = np.finfo(np.float64).tiny
_NO_COURSE, _NO_MOTION = np.zeros((0, 8)), np.zeros((1, 8))
