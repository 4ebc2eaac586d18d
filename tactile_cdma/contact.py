"""What touches the skin: contacts, their forces and places, followed from frame to frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .components import connected
from .errors import SpecError
from .layout import Layout
from .taxels import Readings, Status

SMOOTHING_S = 0.05
"""Time constant of velocities and force rates, s."""
RIM = 0.3
"""Share of the release threshold above which taxels beside a contact count for its force.

Without them a soft contact of 6 kPa loses 3 % of its force; with all that read anything it gains as
much, for a taxel at rest may read one count.
"""


@dataclass(frozen=True, slots=True)
class ContactThresholds:
    """A contact begins where a taxel exceeds contact_pa, Pa.

    It takes in the taxels that hang together with that one and exceed release_pa, Pa, and lasts
    until none of its taxels does.

    Raises SpecError where the release is above the contact.
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

    ids: (c,) int64, from 1 on. age_s: (c,) float64, s since each began.
    load_n: (c,) float64, Σ p·A, N. position_m: (c, 3) float64, centre of pressure Σ r·p·A / Σ p·A.
    force_n: (c, 3) float64, what the touching thing does to the skin, Σ −normal·p·A, N.
    torque_nm: (c, 3) float64, of these forces about the frame's origin, N·m.
    area_m2: (c,) float64, of the taxels in contact. pressure_max_pa: (c,) float32.
    saturated: (c,) bool, a taxel is beyond its range: force and pressure are at least these.
    velocity_m_s: (c, 3) float64, of the position along the skin, smoothed.
    force_rate_n_s: (c,) float64, rise of the force, smoothed.
    taxels: per contact the indices of its taxels, rising.
    """

    ids: NDArray[np.int64]
    age_s: NDArray[np.float64]
    load_n: NDArray[np.float64]
    position_m: NDArray[np.float64]
    force_n: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    area_m2: NDArray[np.float64]
    pressure_max_pa: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    velocity_m_s: NDArray[np.float64]
    force_rate_n_s: NDArray[np.float64]
    taxels: list[NDArray[np.intp]]

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def normals(self) -> NDArray[np.float64]:
        """(c, 3) unit vectors out of the skin, those of the taxels weighted by their forces."""
        return -self.force_n / _length(self.force_n)[:, None]

    @property
    def centre_m(self) -> NDArray[np.float64]:
        """(3,) centre of pressure of all contacts, m; NaN without any."""
        if not len(self):
            return np.full(3, np.nan)
        return np.asarray(self.load_n @ self.position_m / self.load_n.sum())


class ContactTracker:
    """Finds contacts in every frame's pressures, and recognises those of the frame before.

    A contact keeps its id where it shares taxels with itself of the frame before. Where contacts
    merge or split, the id goes along the largest number of shared taxels, and the others end, or
    begin with ids of their own; no id is given twice. Such a change makes centres jump: it does
    not count as motion.

    thresholds may be changed at any time, from other threads too.
    """

    def __init__(self, layout: Layout, thresholds: ContactThresholds, first_id: int = 1) -> None:
        self.thresholds = thresholds
        self.next_id = first_id
        self._beside = np.ascontiguousarray(layout.neighbours.T, dtype=np.intp)
        self._moments = _moments(layout)
        self._contacts = self._nothing = _nothing()
        self._place = np.full(len(layout), -1)  # of each taxel's contact in _contacts; -1: none
        self._readings: Readings | None = None
        self._used = thresholds
        self._t_s = math.nan

    def forget(self) -> None:
        """Whatever is touched in the next frame is a new contact."""
        self._contacts, self._readings, self._t_s = self._nothing, None, math.nan
        self._place[:] = -1

    def update(self, readings: Readings, t_s: float) -> Contacts:
        """The contacts of the frame at device time t_s, s."""
        if t_s < self._t_s:  # the device's clock starts anew
            self.forget()
        passed_s, self._t_s = t_s - self._t_s, t_s
        if readings is self._readings and self.thresholds is self._used:
            self._contacts = _at_rest(self._contacts, passed_s)
        else:
            self._readings, self._used = readings, self.thresholds
            self._contacts = self._find(readings, passed_s)
        return self._contacts

    def _find(self, readings: Readings, passed_s: float) -> Contacts:
        pressure_pa, last = readings.pressure_pa, self._contacts
        # NaN exceeds nothing.
        if not len(last) and not (pressure_pa > self._used.contact_pa).any():
            return last
        taxels, labels = self._touched(pressure_pa)
        origin, torn = _origins(self._place[taxels], labels, len(last))
        self._place[:] = -1
        self._place[taxels] = labels
        if not len(taxels):
            return self._nothing
        rim, labels_of_rim = self._rim(pressure_pa)
        sums = self._sums(
            pressure_pa, np.concatenate([taxels, rim]), np.concatenate([labels, labels_of_rim])
        )
        position_m, force_n = sums[:, 1:4] / sums[:, :1], -sums[:, 4:7]
        ids, age_s = self._identities(origin, passed_s)
        velocity, rate = _motion(position_m, force_n, last, origin, torn, passed_s)
        order = np.argsort(labels, kind="stable")
        taxels, starts = taxels[order], _starts(labels[order], len(origin))
        ends = [*starts[1:], len(taxels)]
        saturated = readings.status[taxels] & np.uint8(Status.SATURATED) > 0
        return Contacts(
            ids=ids,
            age_s=age_s,
            load_n=sums[:, 0],
            position_m=position_m,
            force_n=force_n,
            torque_nm=-sums[:, 7:10],
            area_m2=np.add.reduceat(self._moments[taxels, 0], starts),
            pressure_max_pa=np.maximum.reduceat(pressure_pa[taxels], starts),
            saturated=np.logical_or.reduceat(saturated, starts),
            velocity_m_s=velocity,
            force_rate_n_s=rate,
            taxels=[taxels[start:end] for start, end in zip(starts, ends, strict=True)],
        )

    def _touched(self, pressure_pa: NDArray[np.float32]) -> tuple[NDArray[np.intp], ...]:
        """The taxels in contact, (k,), rising, and the place of each one's contact, 0…c − 1."""
        taxels = np.flatnonzero(pressure_pa > self._used.release_pa)
        labels = connected(taxels, self._beside)
        begins = pressure_pa[taxels] > self._used.contact_pa
        lasts = self._place[taxels] >= 0
        load = np.bincount(labels, pressure_pa[taxels] * self._moments[taxels, 0])
        load[np.bincount(labels, begins | lasts) == 0] = 0.0
        place = np.empty(len(load), dtype=np.intp)  # the strongest first, the others last
        place[np.argsort(-load, kind="stable")] = np.arange(len(load))
        kept = load[labels] > 0
        return taxels[kept], place[labels[kept]]

    def _rim(self, pressure_pa: NDArray[np.float32]) -> tuple[NDArray[np.intp], ...]:
        """Taxels beside contacts that feel them, and these contacts' places."""
        weak = np.flatnonzero((pressure_pa > RIM * self._used.release_pa) & (self._place < 0))
        place = self._place[self._beside[:, weak]].max(axis=0)
        return weak[place >= 0], place[place >= 0]

    def _sums(
        self,
        pressure_pa: NDArray[np.float32],
        taxels: NDArray[np.intp],
        labels: NDArray[np.intp],
    ) -> NDArray[np.float64]:
        """(c, 10): load, load·place, force and torque of each contact, as in _moments."""
        order = np.argsort(labels, kind="stable")
        taxels = taxels[order]
        weighted = self._moments[taxels] * pressure_pa[taxels, None]
        return np.asarray(np.add.reduceat(weighted, _starts(labels[order], labels.max() + 1)))

    def _identities(
        self, origin: NDArray[np.intp], passed_s: float
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ids and ages. origin: (c,) places among the last contacts; −1: new."""
        known, last = origin >= 0, self._contacts
        ids = self.next_id + np.cumsum(~known) - 1
        age_s = np.zeros(len(origin))
        ids[known] = last.ids[origin[known]]
        age_s[known] = last.age_s[origin[known]] + passed_s
        self.next_id += len(origin) - int(np.count_nonzero(known))
        return ids, age_s


def _moments(layout: Layout) -> NDArray[np.float64]:
    """(t, 10) float64: what one pascal on each taxel adds to load, load·place, force and torque.

    Force and torque with the sign of the normal, so that of what the skin does.
    """
    area = layout.areas_m2.astype(np.float64)[:, None]
    places, normals = layout.positions_m.astype(np.float64), layout.normals.astype(np.float64)
    return np.hstack([area, area * places, area * normals, area * np.cross(places, normals)])


def _origins(
    places: NDArray[np.intp], labels: NDArray[np.intp], before: int
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Which contacts of the frame before those of now are.

    places: (k,) place of every touched taxel among the contacts of the frame before, of which
    there were `before`; −1: none. labels: (k,) place among the c of now. Returns (c,) places,
    −1 for new contacts, and (c,) bool, where contacts merged or split.
    """
    count = int(labels.max(initial=-1)) + 1
    origin, torn = np.full(count, -1), np.zeros(count, dtype=bool)
    held = places >= 0
    pairs, shared = np.unique(labels[held] * before + places[held], return_counts=True)
    if not len(pairs):
        return origin, torn
    new, old = np.divmod(pairs, before)
    torn[new] = (np.bincount(new)[new] > 1) | (np.bincount(old)[old] > 1)
    taken: set[int] = set()
    for pair in np.argsort(-shared, kind="stable").tolist():
        heir, ancestor = int(new[pair]), int(old[pair])
        if origin[heir] < 0 and ancestor not in taken:
            origin[heir] = ancestor
            taken.add(ancestor)
    return origin, torn


def _motion(
    position_m: NDArray[np.float64],
    force_n: NDArray[np.float64],
    last: Contacts,
    origin: NDArray[np.intp],
    torn: NDArray[np.bool_],
    passed_s: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Velocities (c, 3) and force rates (c,): differences to the last frame through a low-pass.

    Torn contacts keep what they had. A contact that begins rises from no force.
    """
    known = origin >= 0
    velocity, rate, before_n = (
        np.zeros_like(position_m),
        np.zeros(len(origin)),
        np.zeros(len(origin)),
    )
    velocity[known] = last.velocity_m_s[origin[known]]
    rate[known] = last.force_rate_n_s[origin[known]]
    if not passed_s > 0:  # the first frame of all
        return velocity, rate
    gain = np.where(torn, 0.0, 1.0 - _decay(passed_s))
    force = _length(force_n)
    before_n[known] = _length(last.force_n[origin[known]])
    rate += gain * ((force - before_n) / passed_s - rate)
    step_m = position_m[known] - last.position_m[origin[known]]
    velocity[known] += gain[known, None] * (step_m / passed_s - velocity[known])
    normals = force_n / force[:, None]
    velocity -= (velocity * normals).sum(axis=1, keepdims=True) * normals
    return velocity, rate


def _at_rest(contacts: Contacts, passed_s: float) -> Contacts:
    """The same contacts after a while in which no reading changed."""
    if not len(contacts):
        return contacts
    decay = _decay(passed_s)
    return replace(
        contacts,
        age_s=contacts.age_s + passed_s,
        velocity_m_s=contacts.velocity_m_s * decay,
        force_rate_n_s=contacts.force_rate_n_s * decay,
    )


def _nothing() -> Contacts:
    """No contacts."""
    none, nowhere = np.zeros(0), np.zeros((0, 3))
    return Contacts(
        ids=np.zeros(0, dtype=np.int64),
        age_s=none,
        load_n=none,
        position_m=nowhere,
        force_n=nowhere,
        torque_nm=nowhere,
        area_m2=none,
        pressure_max_pa=np.zeros(0, dtype=np.float32),
        saturated=np.zeros(0, dtype=bool),
        velocity_m_s=nowhere,
        force_rate_n_s=none,
        taxels=[],
    )


def _decay(passed_s: float) -> float:
    """What is left of a smoothed value after a while."""
    return math.exp(-passed_s / SMOOTHING_S)


def _starts(labels: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """(count,) where each of rising labels 0…count − 1 begins."""
    return np.searchsorted(labels, np.arange(count))


def _length(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of vectors (c, 3), (c,); never 0, so that one can divide by it."""
    return np.asarray(np.maximum(np.sqrt(np.square(vectors).sum(axis=1)), _TINY))


_TINY = np.finfo(np.float64).tiny
