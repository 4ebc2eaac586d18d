# SPDX-License-Identifier: Apache-2.0

"""Error and run time of contacts, and what their motion says of slip: `make bench-contact`.

Round contacts on a grid of 7 mm and 10-bit words, through the driver's own chain. Hertz: pressure
√(1 − ρ²) of two elastic bodies; soft: (1 − ρ²)^1.5, the same through a soft cover.

- accuracy: errors of force and centre of single presses, by size and peak of the contact, where
  taxels average over 5.5 mm, and where they feel nothing but their centres.
- rest: the same after a tare, and while drift is followed, on the default curve (whose rest is
  above the highest code) and on curves of the taxels' own. Mean errors of the force: pressures at
  rest add up over the many taxels of a weak contact.
- rim: which taxels beside those in contact should count for its force, also where all voltages are
  a count below those of the calibration.
- time: per frame, next to a plain search and sums contact by contact in Python, which keeps neither
  ids nor speeds. The tracker looks anew for what hangs together where other taxels are touched than
  in the frame before: a few contacts come and go; of all taxels one does, or none.
- slip: contacts that begin to slide, beside grips that hold or pulsate, with ideal sensors and with
  those of the paper (docs/paper.md). The limit of each cue is what one grip of 2 s in twenty
  exceeds; reported are the delay until a slide exceeds it, and the share of slides that do so
  within 0.4 s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import LOOK_S
from tactile_cdma.readings.calibration import Calibration, Curves
from tactile_cdma.readings.contact import SMOOTHING_S, Contacts, ContactTracker
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES
from tactile_cdma.sim.sensor import IDEAL, PAPER, Sensor, SensorModel
from tactile_cdma.words.health import NodeHealth
from tactile_cdma.words.words import silent

from .report import QUICK, Report, in_turn, medians_s
from .style import sheet

Floats = NDArray[np.float64]
Profile = Callable[[Floats], Floats]

SIDE = 20
NODES = SIDE * SIDE
CONFIG = SkinConfig.of({"nodes": NODES, "rows": SIDE, "columns": SIDE, "chip_us": 1.0})
LAYOUT = CONFIG.layout
PITCH_M, TAXEL_M = LAYOUT.pitch_m, 5.5e-3
PERIOD_S = 12.8e-3
AREA, POINT = "area", "point"

RADII = (1.5, 2.0, 2.5, 4.0)
PEAKS_KPA = (4.0, 8.0, 20.0, 45.0, 120.0)
FIRM_KPA = 8.0
"""Tables by radius cover all peaks from this one on."""
PRESSES = 15 if QUICK else 150
RESTED_S = 60.0
OWN = SensorModel(mismatch=0.05).curves(NODES)

SIZES = (16, 256, 1024, 4096)
ROUNDS = 7 if QUICK else 31
IDLE, FEW, ALL, FLICKER = "idle", "few", "all", "all, one flickers"
SCENE_OF = {IDLE: "idle", FEW: "presses", ALL: "all", FLICKER: "all"}


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
    """Runs the driver's chain from the nodes' voltages to contacts."""

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


# Accuracy


@dataclass(frozen=True)
class Errors:
    """Errors of m presses: of_force as a share, of_centre in pitches, (m,) both."""

    of_force: Floats
    of_centre: Floats

    @property
    def percent(self) -> list[float]:
        """Force: rms, 95 %, worst; centre, in % of a pitch: 95 %, worst."""
        force, centre = 100 * np.abs(self.of_force), 100 * self.of_centre
        most = (np.quantile(force, 0.95), force.max(), np.quantile(centre, 0.95), centre.max())
        return [float(np.sqrt(np.mean(np.square(force)))), *map(float, most)]


PERCENT = ["force: rms, %", "95 %", "worst", "centre: 95 %, % of a pitch", "worst"]


def presses(
    skin: Feeling, profile: Profile, pitches: float, peak_kpa: float, sensing: str = AREA
) -> Errors:
    """Errors of presses at random places."""
    force_n = peak_kpa * 1e3 * SHARE[profile] * math.pi * (pitches * PITCH_M) ** 2
    of_force, of_centre = [], []
    for centre_m, pressure_pa in pressed(profile, pitches, peak_kpa, sensing):
        _, contacts = skin.feel(skin.curves.voltage(pressure_pa))
        of_force.append(-contacts.force_n[:, 2].sum() / force_n - 1)
        of_centre.append(np.linalg.norm(contacts.centre_m[:2] - centre_m) / PITCH_M)
    return Errors(np.array(of_force), np.array(of_centre))


def pressed(
    profile: Profile, pitches: float, peak_kpa: float, sensing: str = AREA
) -> Iterator[tuple[Floats, Floats]]:
    """Yield centres near the middle of the skin, m, and pressures of the taxels, (n,) Pa."""
    rng = np.random.default_rng([int(10 * pitches), int(peak_kpa)])
    for _ in range(PRESSES):
        centre_m = rng.uniform(-2, 2, 2) * PITCH_M
        yield centre_m, peak_kpa * 1e3 * felt(profile, centre_m, pitches * PITCH_M, sensing)


def together(errors: list[Errors]) -> Errors:
    return Errors(
        np.concatenate([e.of_force for e in errors]), np.concatenate([e.of_centre for e in errors])
    )


Accuracy = dict[tuple[Profile, str, float], dict[float, Errors]]


def accuracy(report: Report) -> Accuracy:
    """Errors by profile, sensing and radius, for every peak, kPa."""
    found: Accuracy = {}
    for sensing in (AREA, POINT):
        for profile in (hertz, soft):
            for pitches in RADII:
                skin = Feeling()
                found[profile, sensing, pitches] = {
                    peak: presses(skin, profile, pitches, peak, sensing) for peak in PEAKS_KPA
                }
    report.table(
        ["taxels feel", "contact", "radius, pitches", *PERCENT],
        [
            [sensing, profile.__name__, pitches, *firm(by_peak).percent]
            for (profile, sensing, pitches), by_peak in found.items()
        ],
    )
    report.table(
        ["taxels feel", "contact", "peak, kPa", *PERCENT],
        [
            [AREA, profile.__name__, peak, *found[profile, AREA, 2.5][peak].percent]
            for profile in (hertz, soft)
            for peak in PEAKS_KPA
        ],
    )
    return found


def firm(by_peak: dict[float, Errors]) -> Errors:
    return together([errors for peak, errors in by_peak.items() if peak >= FIRM_KPA])


def rest(report: Report) -> float:
    """Worst bias, as a share of the force, of tared skins under contacts of FIRM_KPA and more."""
    rows, worst = [], 0.0
    for curves, of in ((None, "the default"), (OWN, "their own")):
        for state in ("as built", "tared", f"tared, {RESTED_S:g} s of drift followed"):
            skin = Feeling(curves)
            if state != "as built":
                skin.rest(2.0)
                skin.taxels.tare(CONFIG.contact.contact_pa)
            if state.endswith("followed"):
                skin.rest(RESTED_S)
            found = {peak: presses(skin, soft, 2.5, peak) for peak in (4.0, 8.0, 20.0)}
            means = {peak: float(errors.of_force.mean()) for peak, errors in found.items()}
            if state != "as built":
                worst = max(worst, *(abs(means[peak]) for peak in means if peak >= FIRM_KPA))
            rows.append([of, state, *(100 * mean for mean in means.values())])
    report.table(["curves", "skin", *(f"mean error at {p} kPa, %" for p in (4, 8, 20))], rows)
    return worst


def rim(report: Report) -> None:
    """Mean errors of the force of a soft contact, by the taxels that are counted."""
    rows = []
    lsb_v = CONFIG.adc.lsb_v
    for curves, below_v, of in (
        (None, 0.0, "the default"),
        (OWN, 0.0, "their own"),
        (OWN, lsb_v, "their own, one count off"),
    ):
        for peak_kpa in (4.0, 6.0, 8.0):
            skin, loads_n = Feeling(curves), []
            for _, pressure_pa in pressed(soft, 2.5, peak_kpa):
                readings, contacts = skin.feel(skin.curves.voltage(pressure_pa) - below_v)
                [taxels] = contacts.taxels
                beside = np.unique(LAYOUT.neighbours[taxels])
                alone, all_n = (
                    readings.pressure_pa[x].sum() * PITCH_M**2 for x in (taxels, beside)
                )
                loads_n.append([alone, contacts.load_n[0], all_n])
            force_n = peak_kpa * 1e3 * SHARE[soft] * math.pi * (2.5 * PITCH_M) ** 2
            means = 100 * (np.mean(loads_n, axis=0) / force_n - 1)
            rows.append([of, peak_kpa, *means.tolist()])
    ways = ["contact alone: mean error, %", "and the rim", "and all beside"]
    report.table(["curves", "peak, kPa", *ways], rows)


# Run time


def frames(nodes: int, scene: str) -> list[Readings]:
    """Readings of a skin in a scene, frame by frame."""
    skin, curves = SimOptions().skin(nodes), Curves.of([CONFIG.curve] * nodes)
    status, result = np.zeros(nodes, dtype=np.uint8), []
    for t_s in np.arange(64) * 20e-3:
        code = CONFIG.adc.code(curves.voltage(SCENES[scene](t_s, skin)))
        voltage_v = CONFIG.adc.voltage(code).astype(np.float32)
        result.append(Readings(curves.pressure(voltage_v), voltage_v, status))
    return result


def times(report: Report) -> dict[tuple[int, str], tuple[float, float]]:
    """Median time per frame, s, of the tracker and of the plain search, by size and scene."""
    result, rows = {}, []
    for nodes in SIZES:
        layout = Layout.grid(nodes, 0, 0, PITCH_M, TAXEL_M)
        for state, scene in SCENE_OF.items():
            readings = frames(nodes, scene)
            if state == FLICKER:
                for every_other in readings[::2]:
                    every_other.pressure_pa[0] = 0.0
            found = medians_s(
                {
                    "tracker": in_turn(ContactTracker(layout, CONFIG.contact).update, readings),
                    "plain": in_turn(Plain(layout).update, readings),
                },
                ROUNDS,
                least_s=20e-3,
            )
            result[nodes, state] = found["tracker"], found["plain"]
            rows.append([nodes, state, *(1e6 * value for value in result[nodes, state])])
    report.table(["taxels", "touched", "µs per frame", "plain Python, µs"], rows)
    return result


class Plain:
    """Searches plainly: from taxel to taxel, then sums contact by contact."""

    def __init__(self, layout: Layout) -> None:
        self._beside = layout.neighbours.tolist()
        self._areas_m2, self._places_m = layout.areas_m2, layout.positions_m
        self._normals = layout.normals

    def update(self, readings: Readings, t_s: float) -> list[tuple[Floats, ...]]:
        """(force, centre, torque) of each contact."""
        found = []
        left = set(np.flatnonzero(readings.pressure_pa > CONFIG.contact.release_pa).tolist())
        while left:
            taxels = [left.pop()]
            for taxel in taxels:  # grows meanwhile
                for other in self._beside[taxel]:
                    if other in left:
                        left.remove(other)
                        taxels.append(other)
            if readings.pressure_pa[taxels].max() > CONFIG.contact.contact_pa:
                found.append(self._sums(taxels, readings.pressure_pa[taxels]))
        return found

    def _sums(self, taxels: list[int], pressure_pa: NDArray[np.float32]) -> tuple[Floats, ...]:
        load_n = (pressure_pa * self._areas_m2[taxels]).astype(np.float64)
        forces_n = -self._normals[taxels] * load_n[:, None]
        places_m = self._places_m[taxels]
        centre_m = load_n @ places_m / load_n.sum()
        return forces_n.sum(axis=0), centre_m, np.cross(places_m, forces_n).sum(axis=0)


# Slip

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
    """Give both cues under a soft contact, 2.5 pitches wide at 10 N and growing as Hertz's does.

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
    """Hold a grip that does not move; its force pulsates by a share of itself, at 0.5 to 3 Hz."""
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
    """Hold a grip for BEFORE_S, then let it slide."""
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
    """Return the share of slides seen, and the median of their delays."""
    seen = np.isfinite(delays)
    if not seen.any():
        return "0 %"
    return f"{100 * seen.mean():.0f} %, {1e3 * np.median(delays[seen]):.0f} ms"


def main() -> None:
    report = Report("contact", "Contacts: error, run time, and what their motion says of slip")
    found = accuracy(report)
    bias = rest(report)
    rim(report)
    times_s = times(report)
    slipped = slips(report)
    wide = [firm(found[p, AREA, pitches]) for p in (hertz, soft) for pitches in (2.5, 4.0)]
    of_wide, speed = together(wide), slipped["paper", 10.0, CENTRE, 10]
    report.finish(
        picture(found, times_s, slipped),
        force_error_max=float(np.abs(of_wide.of_force).max()),
        centre_error_max=float(of_wide.of_centre.max()),
        tared_bias_max=bias,
        us_idle_4096=times_s[4096, IDLE][0] * 1e6,
        us_few_4096=times_s[4096, FEW][0] * 1e6,
        us_all_4096=times_s[4096, FLICKER][0] * 1e6,
        slip_10_mm_s_detected=float(np.isfinite(speed).mean()),
        slip_10_mm_s_delay_ms=float(1e3 * np.median(speed)),
    )


def picture(
    found: Accuracy, times_s: dict[tuple[int, str], tuple[float, float]], slipped: Slips
) -> Figure:
    figure = sheet(860)
    left, middle, right = figure.subplots(3, 1)
    for profile, colour in ((hertz, "C3"), (soft, "C0")):
        for sensing, style in ((AREA, "-"), (POINT, ":")):
            most = [firm(found[profile, sensing, pitches]).percent[1] for pitches in RADII]
            label = f"{profile.__name__}, taxels feel {sensing}"
            left.plot(RADII, most, style, color=colour, marker="o", label=label)
    left.set_xlabel("radius, pitches")
    left.set_ylabel("error of the force, 95 %, in %")
    left.set_yscale("log")
    left.set_title(f"Presses with peaks of {PEAKS_KPA[1]:g} to {PEAKS_KPA[-1]:g} kPa")
    for state, colour in zip(SCENE_OF, ("C2", "C0", "C1", "C3"), strict=True):
        tracker, plain = np.array([times_s[nodes, state] for nodes in SIZES]).T * 1e6
        middle.loglog(SIZES, tracker, "o-", color=colour, label=f"touched: {state}")
        middle.loglog(SIZES, plain, "x:", color=colour)
    middle.plot([], [], "x:", color="0.5", label="the same in plain Python")
    middle.set_xlabel("taxels")
    middle.set_ylabel("µs per frame")
    middle.set_title("Time per frame")
    for cue, colour in ((CENTRE, "C0"), (ENERGY, "C3")):
        for kind, style in (("ideal", "-"), ("paper", "--")):
            seen = [
                100 * np.mean([np.isfinite(slipped[kind, f, cue, v]) for f in FORCES_N])
                for v in SPEEDS_MM_S
            ]
            right.semilogx(
                SPEEDS_MM_S, seen, style, color=colour, marker="o", ms=4, label=f"{cue}, {kind}"
            )
    right.set_xticks(SPEEDS_MM_S, [str(speed) for speed in SPEEDS_MM_S])
    right.set_xticks([], minor=True)
    right.set_xlabel("speed of the slide, mm/s")
    right.set_ylabel(f"slides seen within {SLIDE_S:g} s, %")
    right.set_title("Slip, one false alarm in 20 grips")
    for axes in (left, middle, right):
        axes.legend(handlelength=3.5)
    return figure


if __name__ == "__main__":
    main()
