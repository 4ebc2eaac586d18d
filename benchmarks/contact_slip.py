# SPDX-License-Identifier: Apache-2.0

"""Round contacts on a simulated skin, and what their motion says of slip: for `make bench-contact`.

Slip: contacts that begin to slide are compared with grips that hold or pulsate, with ideal sensors
and with those of the paper (docs/sensor.md). The limit of each cue is what one grip of 2 s in
twenty exceeds; reported are the delay until a slide exceeds it, and the share of slides that do so
within 0.4 s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.readings.baseline import LOOK_S
from tactile_cdma.readings.calibration import Calibration, Curves
from tactile_cdma.readings.contact import SMOOTHING_S, Contacts, ContactTracker
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.sim.sensor import IDEAL, PAPER, Sensor, SensorModel
from tactile_cdma.words.decode import silent
from tactile_cdma.words.health import NodeHealth

from .report import QUICK, Report

Floats = NDArray[np.float64]
Profile = Callable[[Floats], Floats]

SIDE = 20
NODES = SIDE * SIDE
CONFIG = SkinConfig.of({"nodes": NODES, "rows": SIDE, "columns": SIDE, "chip_us": 1.0})
LAYOUT = CONFIG.layout
PITCH_M, TAXEL_M = LAYOUT.pitch_m, 5.5e-3
PERIOD_S = 12.8e-3
AREA, POINT = "area", "point"


def hertz(rho: Floats) -> Floats:
    return np.asarray(np.sqrt(np.clip(1 - np.square(rho), 0, None)))


def soft(rho: Floats) -> Floats:
    return hertz(rho) ** 3


SHARE: dict[Profile, float] = {hertz: 2 / 3, soft: 2 / 5}
"""Mean pressure over peak pressure: ∫ profile(ρ) 2ρ dρ."""


def felt(profile: Profile, centre_m: Floats, radius_m: float, sensing: str = AREA) -> Floats:
    """(n,) relative pressure on the taxels: over their sensing areas, or at their centres."""
    steps = (np.arange(9) - 4) / 9 * TAXEL_M if sensing == AREA else np.zeros(1)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    away_m = LAYOUT.flat_m - centre_m
    near = np.hypot(*away_m.T) < radius_m + PITCH_M
    distance_m = np.linalg.norm(away_m[near, None, :] + offsets, axis=-1)
    result = np.zeros(NODES)
    result[near] = profile(distance_m / radius_m).mean(axis=1)
    return result


class Feeling:
    """The driver's chain from the nodes' voltages to contacts."""

    def __init__(self, curves: Curves | None = None) -> None:
        """curves: of the sensors and of their calibration; None: the default."""
        self.curves = curves or Curves.of([CONFIG.curve] * NODES)
        self.taxels = Pipeline(CONFIG).taxels
        self.taxels.calibrate(Calibration(self.curves, np.zeros(NODES, dtype=bool)))
        self._health = NodeHealth(CONFIG.spec)
        self._tracker = ContactTracker(LAYOUT, CONFIG.contact)
        self._words = replace(silent(NODES, 0.0), active=np.ones(NODES, dtype=bool))
        self._now_s = 0.0

    def feel(self, voltage_v: Floats, passed_s: float = PERIOD_S) -> tuple[Readings, Contacts]:
        self._now_s += passed_s
        words = replace(self._words, codes=CONFIG.adc.code(voltage_v).astype(np.int32))
        readings = self.taxels.update(words, self._now_s, self._health)
        return readings, self._tracker.update(readings, self._now_s)

    def rest(self, seconds: float) -> None:
        """Let time pass without a touch."""
        for _ in np.arange(0.0, seconds, LOOK_S):
            self.feel(self.curves.voltage(0.0), LOOK_S)


FORCES_N = (10.0,) if QUICK else (3.0, 10.0, 30.0)
SPEEDS_MM_S = (2, 5, 10, 20, 50)
GRIPS, SLIDES = (20, 8) if QUICK else (40, 20)
GRIP_S, SLIDE_S, BEFORE_S = 2.0, 0.4, 0.5
SETTLED_S = 0.25
FALSE_SHARE = 0.05
NOISE_LSB = 0.3
CENTRE, ENERGY = "centre's speed", "high-pass energy"
CUES = (CENTRE, ENERGY)

Track = tuple[Floats, dict[str, Floats]]
"""Times, s, and the value of each cue."""
Place = Callable[[float], Floats]
Force = Callable[[float], float]


def track(model: SensorModel, place: Place, force_n: Force, seconds: float) -> Track:
    """Both cues under a soft contact, 2.5 pitches wide at 10 N and growing as Hertz's does.

    Energy: of what a high-pass of the tracker's time constant leaves of the taxels' shares in the
    force, for the force itself may change in any grip.
    """
    skin, sensor = Feeling(), Sensor(model, NODES)
    times_s = np.arange(0.0, seconds, PERIOD_S)
    cues = {name: np.zeros(len(times_s)) for name in CUES}
    usual, kept = np.zeros(NODES), math.exp(-PERIOD_S / SMOOTHING_S)
    for i, t_s in enumerate(times_s.tolist()):
        radius_m = 2.5 * PITCH_M * (force_n(t_s) / 10) ** (1 / 3)
        peak_pa = force_n(t_s) / (SHARE[soft] * math.pi * radius_m**2)
        pressure_pa = peak_pa * felt(soft, place(t_s), radius_m)
        readings, contacts = skin.feel(sensor.step(pressure_pa, t_s))
        if not len(contacts):
            continue
        share = readings.pressure_pa / readings.pressure_pa.sum(dtype=np.float64)
        usual = kept * usual + (1 - kept) * share if usual.any() else share
        cues[CENTRE][i] = 1e3 * np.linalg.norm(contacts.velocity_m_s[0])
        cues[ENERGY][i] = np.sqrt(np.square(share - usual).sum())
    return times_s, cues


def somewhere(rng: np.random.Generator) -> Floats:
    return rng.uniform(-1, 1, 2) * PITCH_M


def grip(model: SensorModel, force_n: float, rng: np.random.Generator, swing: float) -> Track:
    """A grip that does not move; its force pulsates by a share of itself, at 0.5 to 3 Hz."""
    there, rate_hz, phase = somewhere(rng), rng.uniform(0.5, 3.0), rng.uniform(0, 2 * math.pi)
    return track(
        model,
        lambda t: there,
        lambda t: force_n * (1 + swing * math.sin(2 * math.pi * rate_hz * t + phase)),
        SETTLED_S + GRIP_S,
    )


def closing(model: SensorModel, force_n: float, rng: np.random.Generator) -> Track:
    """A contact begins, and grows to its force within 0.2 s."""
    there = somewhere(rng)
    return track(model, lambda t: there, lambda t: force_n * min(1.0, t / 0.2 + 1e-3), 0.2)


def rolling(model: SensorModel, force_n: float, rng: np.random.Generator) -> Track:
    """The centre of a load moves by 2 mm within 0.3 s, while its force doubles."""
    there, towards = somewhere(rng), direction(rng)

    def done(t_s: float) -> float:
        return min(max((t_s - BEFORE_S) / 0.3, 0.0), 1.0)

    return track(
        model,
        lambda t: there + 2e-3 * done(t) * towards,
        lambda t: force_n * (1 + done(t)),
        BEFORE_S + 0.4,
    )


def slide(model: SensorModel, force_n: float, rng: np.random.Generator, mm_s: float) -> Track:
    """A grip that is held for BEFORE_S, then slides."""
    there, towards = somewhere(rng), direction(rng)
    return track(
        model,
        lambda t: there + 1e-3 * mm_s * max(0.0, t - BEFORE_S) * towards,
        lambda t: force_n,
        BEFORE_S + SLIDE_S,
    )


def direction(rng: np.random.Generator) -> Floats:
    angle = rng.uniform(0, 2 * math.pi)
    return np.array([math.cos(angle), math.sin(angle)])


def highest(tracks: list[Track], cue: str, after_s: float = SETTLED_S) -> Floats:
    return np.array([cues[cue][t_s >= after_s].max() for t_s, cues in tracks])


def delays_s(tracks: list[Track], cue: str, limit: float) -> Floats:
    """Time from the start of each slide until the cue exceeds a limit, s; ∞ if it never does."""
    found = []
    for t_s, cues in tracks:
        over = t_s[(t_s >= BEFORE_S) & (cues[cue] > limit)]
        found.append(over[0] - BEFORE_S if len(over) else math.inf)
    return np.array(found)


Slips = dict[tuple[str, float, str, int], Floats]


def slips(report: Report) -> Slips:
    """Delays of every slide, s, by sensor, force, cue and speed."""
    found: Slips = {}
    rows, motions = [], []
    for kind in (IDEAL, PAPER):
        model = SensorModel(kind=kind, noise_v=NOISE_LSB * CONFIG.adc.lsb_v)
        for force_n in FORCES_N:
            rng = np.random.default_rng([int(force_n), 5])
            held = [grip(model, force_n, rng, 0.0) for _ in range(GRIPS // 2)]
            pulsating = [grip(model, force_n, rng, 0.3) for _ in range(GRIPS // 2)]
            begun = [closing(model, force_n, rng) for _ in range(SLIDES)]
            rolled = [rolling(model, force_n, rng) for _ in range(SLIDES)]
            slides = {
                speed: [slide(model, force_n, rng, speed) for _ in range(SLIDES)]
                for speed in SPEEDS_MM_S
            }
            for cue in CUES:
                limit = float(np.quantile(highest(held + pulsating, cue), 1 - FALSE_SHARE))
                delays = {speed: delays_s(slides[speed], cue, limit) for speed in SPEEDS_MM_S}
                found |= {(kind, force_n, cue, speed): delays[speed] for speed in SPEEDS_MM_S}
                rows.append([kind, force_n, cue, limit, *map(in_words, delays.values())])
            kinds = ((held, SETTLED_S), (pulsating, SETTLED_S), (begun, 0.0), (rolled, BEFORE_S))
            most = [float(highest(tracks, CENTRE, after_s).max()) for tracks, after_s in kinds]
            motions.append([kind, force_n, *most])
    report.table(
        ["sensors", "N", "highest speed held, mm/s", "pulsating", "closing", "rolling"], motions
    )
    speeds = [f"{speed} mm/s" for speed in SPEEDS_MM_S]
    report.table(["sensors", "N", "cue", "limit", *speeds], rows)
    return found


def in_words(delays: Floats) -> str:
    """Share of slides seen, and the median of their delays."""
    seen = np.isfinite(delays)
    if not seen.any():
        return "0 %"
    return f"{100 * seen.mean():.0f} %, {1e3 * np.median(delays[seen]):.0f} ms"
