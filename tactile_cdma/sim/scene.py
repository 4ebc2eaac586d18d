# SPDX-License-Identifier: Apache-2.0

"""Plays what touches the skin: pressure fields over time, or what a program presses on it."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from ..base.arrays import Floats, Indices
from ..places.layout import Layout
from .indenters import Foundation, Indenter

PEAK_PA = 120e3
"""Peak pressure of a firm contact: well inside the second stage of the paper's sensor."""
EXTERNAL = "external"
"""Name of the scene in which a program says what touches the skin."""

REST_S, EVERY_S, BEGUN_S = 5.0, 20.0, 2.0
"""In the scene "demo" nothing touches for REST_S in every EVERY_S, and at its begin BEGUN_S of the
first such rest are over, s. Chosen: a tare needs a word of every node, once per s, and 1 s more."""

_RISING_KPA = (*range(0, 60, 5), *range(60, 141, 10))
STEPS_KPA = (*_RISING_KPA, *_RISING_KPA[-2:0:-1])
"""The staircase of "steps", kPa: up to the end of the range and down again, repeatedly."""
DWELL_S = 2.0
"""Duration of each of these loads, s: the paper's sensor settles in 0.74 s."""
TURNS_KPA = (0, 140, 20, 90, 0, 55, 10, 120, 40, 75, 0, 110, 60, 140, 0, 40)
"""The loads between which "cycles" swings, kPa, repeatedly."""
TURN_S = 2.0
"""Duration of each swing, s."""


@dataclass(frozen=True)
class SkinGeometry:
    """Places the nodes that a scene presses on: those under a skin, unrolled.

    positions_m: (n, 2) float64, place of every node about the centre of the skin, m.
    pitch_m: distance of neighbouring taxels, m. seed: places the contacts of random scenes.
    layout: of the skin; taxels: (n,), the taxel there that each node is behind.
    """

    positions_m: Floats
    pitch_m: float
    layout: Layout
    taxels: Indices
    seed: int = 0

    @classmethod
    def of(cls, layout: Layout, nodes: int, seed: int = 0) -> Self:
        """Place the nodes 1…n at the places that a layout gives them.

        What a node without a place feels nobody sees: it is put where the first taxel's is.
        """
        placed = np.flatnonzero(layout.nodes)
        flat_m = layout.flat_m[placed].astype(np.float64)
        flat_m -= (flat_m.min(axis=0) + flat_m.max(axis=0)) / 2
        taxel = np.zeros(nodes, dtype=np.intp)  # of every node, among those placed
        taxel[layout.nodes[placed] - 1] = np.arange(len(placed))
        return cls(flat_m[taxel], layout.pitch_m, layout, placed[taxel], seed)

    @property
    def half_extent_m(self) -> Floats:
        """Return (2,) distance from the centre of the skin to its outermost taxels, m."""
        return np.asarray(np.abs(self.positions_m).max(axis=0))

    @cached_property
    def cover(self) -> Foundation:
        """Return the elastic cover over all nodes, for objects in the skin's own frame."""
        layout, at = self.layout, self.taxels
        places = layout.positions_m[at], layout.normals[at], layout.areas_m2[at]
        return Foundation(*places, layout.aspect)

    @cached_property
    def contacts(self) -> list[tuple[Floats, float, float, float, float]]:
        """Draw the contacts of the scene "presses": three, and more on a large skin.

        Each has a centre, (2,), m, a radius, m, a peak, Pa, a period, s, and a phase, in periods.
        """
        rng = np.random.default_rng([self.seed, 0, 1])  # [seed, frame] belongs to the line's noise
        count = min(3 + len(self.positions_m) // 128, 16)
        return [
            (
                self.positions_m[rng.integers(len(self.positions_m))],
                rng.uniform(0.9, 2.2) * self.pitch_m,
                rng.uniform(0.25, 1.0) * PEAK_PA,
                rng.uniform(2.0, 5.0),
                rng.uniform(),
            )
            for _ in range(count)
        ]


Scene = Callable[[float, SkinGeometry], Floats]
"""(t_s, skin) → (n,) float64, Pa: pressure on every taxel t_s seconds after START."""


class External:
    """The scene of a program: the objects that touch the skin since it last said so.

    Their pressures are computed once, so that what lies still costs nothing.
    """

    def __init__(self) -> None:
        self._objects: tuple[Indenter, ...] = ()
        self._pressed: tuple[SkinGeometry, Floats] | None = None

    def press(self, objects: Sequence[Indenter]) -> None:
        """From now on these touch the skin, and no others."""
        self._objects, self._pressed = tuple(objects), None

    def __call__(self, t_s: float, skin: SkinGeometry) -> Floats:
        """Return pressures at present, whatever t_s is; a Scene."""
        if self._pressed is None or self._pressed[0] is not skin:
            self._pressed = skin, skin.cover.pressure_pa(self._objects)
        return self._pressed[1]


def idle(t_s: float, skin: SkinGeometry) -> Floats:
    """Leave the skin untouched."""
    return np.zeros(len(skin.positions_m))


def press(t_s: float, skin: SkinGeometry) -> Floats:
    """Press a fingertip on the node nearest the centre, 2 s on and 2 s off."""
    nearest = np.argmin(np.square(skin.positions_m).sum(axis=1))
    peak_pa = PEAK_PA * _on_off(t_s / 4.0)
    return _bump(skin, skin.positions_m[nearest], 0.9 * skin.pitch_m, peak_pa)


def presses(t_s: float, skin: SkinGeometry) -> Floats:
    """Press with several contacts of different size and force, each at its own pace."""
    return _strongest(
        _bump(skin, centre_m, radius_m, peak_pa * _on_off(t_s / period_s + phase))
        for centre_m, radius_m, peak_pa, period_s, phase in skin.contacts
    )


def moving(t_s: float, skin: SkinGeometry) -> Floats:
    """Let one contact wander over the whole skin on a Lissajous figure, its force breathing."""
    swing = 0.85 * skin.half_extent_m
    centre = swing * [math.sin(2 * math.pi * t_s / 5.0), math.sin(2 * math.pi * t_s / 7.0 + 1.0)]
    radius_m = max(1.6 * skin.pitch_m, 0.25 * float(skin.half_extent_m.max()))
    return _bump(skin, centre, radius_m, PEAK_PA * (0.8 + 0.2 * math.sin(2 * math.pi * t_s / 3.0)))


def demo(t_s: float, skin: SkinGeometry) -> Floats:
    """Let one contact wander over the skin, which rests at first and again, to be tared."""
    since_s = (t_s + BEGUN_S) % EVERY_S
    return idle(t_s, skin) if since_s < REST_S else moving(since_s - REST_S, skin)


def all_taxels(t_s: float, skin: SkinGeometry) -> Floats:
    """Press every taxel by 15 to 115 kPa: a slow wave that crosses the skin."""
    x = skin.positions_m[:, 0] / max(2 * float(skin.half_extent_m[0]), skin.pitch_m)
    return 65e3 + 50e3 * np.sin(2 * np.pi * (x - t_s / 8.0))


def hand(t_s: float, skin: SkinGeometry) -> Floats:
    """Rest a life-size hand: on most of a small skin, palm and five fingers on a large one."""
    load_pa = PEAK_PA * (0.75 + 0.25 * math.sin(2 * math.pi * t_s / 4.0))
    palm = 0.6 * _profile(_radius_m(skin.positions_m / _PALM_M))
    fingers = [
        _profile(_distance_m(skin.positions_m, np.array(base), np.array(tip)) / _FINGER_RADIUS_M)
        for base, tip in _FINGERS_M
    ]
    return load_pa * _strongest([palm, *fingers])


def steps(t_s: float, skin: SkinGeometry) -> Floats:
    """Apply the loads STEPS_KPA one after the other, DWELL_S each."""
    return _everywhere(skin, STEPS_KPA[int(t_s / DWELL_S) % len(STEPS_KPA)])


def cycles(t_s: float, skin: SkinGeometry) -> Floats:
    """Follow half a cosine in TURN_S from each load of TURNS_KPA to the next."""
    turn, share = divmod(t_s / TURN_S, 1.0)
    begin, end = (TURNS_KPA[(int(turn) + step) % len(TURNS_KPA)] for step in (0, 1))
    return _everywhere(skin, begin + (end - begin) * (0.5 - 0.5 * math.cos(math.pi * share)))


SCENES: dict[str, Scene] = {
    "demo": demo,
    "idle": idle,
    "press": press,
    "presses": presses,
    "moving": moving,
    "all": all_taxels,
    "hand": hand,
}
LOADS: dict[str, Scene] = {"steps": steps, "cycles": cycles}
"""Scenes for calibration: known loads, the same on all taxels."""


_PALM_M = (0.042, 0.045)
_FINGER_RADIUS_M = 0.010
_FINGERS_M = (
    ((-0.030, 0.048), (-0.042, 0.100)),
    ((-0.010, 0.052), (-0.014, 0.118)),
    ((0.010, 0.052), (0.012, 0.112)),
    ((0.030, 0.046), (0.038, 0.092)),
    ((-0.040, -0.005), (-0.078, 0.035)),
)
"""Base and tip of index, middle, ring and little finger and thumb about the palm's centre, m."""


def _bump(skin: SkinGeometry, centre_m: Floats, radius_m: float, peak_pa: float) -> Floats:
    """Return the pressure under a round contact, (n,) Pa."""
    return peak_pa * _profile(_radius_m(skin.positions_m - centre_m) / radius_m)


def _profile(rho: Floats) -> Floats:
    """Relative pressure at the relative radius ρ: (1 − ρ²)^1.5 inside the contact, 0 outside.

    Hertz's contact has (1 − ρ²)^0.5; the soft cover of the skin rounds off its vertical edge.
    """
    return np.power(np.clip(1.0 - np.square(rho), 0.0, None), 1.5)


def _on_off(cycles: float) -> float:
    """Go 0…1…0 once per cycle: on for half of it, with soft edges of a tenth of a cycle."""
    from_middle = abs(cycles % 1.0 - 0.5)
    ramp = min(max((0.3 - from_middle) / 0.1, 0.0), 1.0)
    return ramp * ramp * (3.0 - 2.0 * ramp)


def _distance_m(points: Floats, start: Floats, end: Floats) -> Floats:
    """Return the distance of points (n, 2) to a line segment, (n,)."""
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    return _radius_m(points - start - share[:, None] * along)


def _radius_m(points: Floats) -> Floats:
    """Return the distance of points (n, 2) to the origin, (n,)."""
    return np.asarray(np.hypot(points[:, 0], points[:, 1]))


def _strongest(fields: Iterable[Floats]) -> Floats:
    return np.asarray(np.stack(list(fields)).max(axis=0))


def _everywhere(skin: SkinGeometry, load_kpa: float) -> Floats:
    return np.full(len(skin.positions_m), load_kpa * 1e3)
