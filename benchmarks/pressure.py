# SPDX-License-Identifier: Apache-2.0

"""Error and run time of the pressure chain: `make bench-pressure`.

Skins of simulated sensors (docs/sensor.md), each taxel with a curve of its own, behind 10-bit
converters. Errors are of data that was used neither to calibrate nor to identify.

- static: curves fitted to a staircase of loads, for ideal sensors at random pressures; the error is
  compared with that of the quantisation alone, LSB/√12 on each taxel's own slope, stage by stage.
- dynamics: sensors with lag and hysteresis under random cycles; compensation with dynamics
  identified from other cycles, with lag, loops or both wrong by 10 %, as when sensors have changed
  since ("drifted"), and with only one of them undone. These sensors follow the very model that
  compensation inverts, and their loads change only from frame to frame, as it assumes.
- others: compensation of sensors of other models, under loads that move between frames, with
  dynamics identified from them (or refused), and with those of the paper's sensor.
- tare: contacts that stay for an hour while drift is followed; one counts as swallowed if it reads
  less than half of its load at the end. Also, the drift left on a warming skin without contacts.
- chains: everything at once, on skins that are mounted with up to 3 kPa of preload, for each chain
  from the plain curve to compensation: error, and time of a frame in which all nodes transmit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.base.errors import CalibrationError
from tactile_cdma.calibrating.identify import identify
from tactile_cdma.calibrating.load_points import LoadPoints
from tactile_cdma.calibrating.skin_fit import fit_skin
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import LOOK_S, Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.contact import ContactThresholds, ContactTracker
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.dynamics import Compensator, Dynamics, Hysteresis, Lag
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.tare import take_tare
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES
from tactile_cdma.sim.sensor import PAPER_DYNAMICS, Sensor, SensorModel

from .report import QUICK, Report, medians_s

Floats = NDArray[np.float64]
Distortion = Callable[[Floats, float], Floats]
"""(true pressures (n,), Pa, their duration, s) → apparent pressures (n,), Pa."""

ADC = AdcScale()
PERIOD_S = 12.8e-3
NODES = 16 if QUICK else 64
SKINS = 2 if QUICK else 8
CYCLES_S = 20.0 if QUICK else 120.0
TAUGHT_S = 45.0 if QUICK else 90.0
MISMATCH = 0.05
CALIBRATION_PA = np.concatenate([np.arange(0.0, 50e3, 2.5e3), np.arange(50e3, 140.1e3, 5e3)])
CONTACTS_PA = (250.0, 350.0, 500.0, 1e3, 5e3, 20e3, 49e3, 70e3, 130e3)
WARMING_V = 0.003
PRELOAD_PA = 3e3
TARE_S, REST_S = 5.0, 10.0
"""A mounted skin is tared, and first touched."""
DRIFTED = (0.9, 1.1)
BIG = 4096
ROUNDS = 9 if QUICK else 31
STEADY_S = 300.0 if QUICK else 3600.0
RULES = RestRules(drift_pa_per_min=60.0, contact_pa=1e3, release_pa=500.0)
MATCHED = "as identified"
OTHER_SKINS = 1 if QUICK else 4
HIGHEST_PA = 140e3
PARTS = 2
"""Steps from one frame to the next."""


def quantised(voltage_v: Floats) -> Floats:
    """The voltage as the node's converter reads it."""
    return ADC.voltage(ADC.code(voltage_v))


def rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def calibrated(model: SensorModel, nodes: int = NODES) -> Calibration:
    """A calibration of such a skin, from a staircase of settled loads."""
    voltage_v = quantised(np.array([model.curves(nodes).voltage(p) for p in CALIBRATION_PA]))
    loads, numbers = np.meshgrid(CALIBRATION_PA, np.arange(1, nodes + 1), indexing="ij")
    points = LoadPoints(
        numbers.ravel(),
        loads.ravel(),
        voltage_v.ravel(),
        line=np.arange(loads.size),
        source="staircase",
    )
    fit = fit_skin(points, nodes, ADC)
    assert not fit.refused, fit.refused
    curves = Curves.of([fit.curves[node] for node in range(1, nodes + 1)])
    return Calibration(curves, np.zeros(nodes, dtype=bool), "bench")


# Static


def static(report: Report) -> dict[str, float]:
    """Worst of both stages of rms error over that of the quantisation, by curves used."""
    ratios: dict[str, list[list[float]]] = {"default curve": [], "fitted": [], "true": []}
    for seed in range(SKINS):
        model = SensorModel(mismatch=MISMATCH, seed=seed)
        truth, rng = model.curves(NODES), np.random.default_rng([seed, 1])
        subjects = {
            "default curve": Calibration.default(PressureCurve.two_stage(), NODES).curves,
            "fitted": calibrated(model).curves,
            "true": truth,
        }
        for name, curves in subjects.items():
            ratios[name].append([_over_quantisation(truth, curves, s, rng) for s in (0, 1)])
    mean = {name: np.sqrt(np.mean(np.square(values), axis=0)) for name, values in ratios.items()}
    report.table(
        ["curves", "rms error / quantisation, stage 1", "stage 2"],
        [[name, float(first), float(second)] for name, (first, second) in mean.items()],
    )
    return {name: float(values.max()) for name, values in mean.items()}


def _over_quantisation(
    truth: Curves, curves: Curves, stage: int, rng: np.random.Generator
) -> float:
    """Rms over taxels and pressures of error / (LSB/√12 in Pa) within one stage."""
    low_pa, high_pa = truth.pressure_pa[stage], truth.pressure_pa[stage + 1]
    slope = (truth.voltage_v[stage] - truth.voltage_v[stage + 1]) / (high_pa - low_pa)
    # Voltages above the last code, one below vref, read as that code.
    low_pa = np.where(stage == 0, truth_pressure_of(truth, ADC.vref_v - 1.5 * ADC.lsb_v), low_pa)
    limit_pa = ADC.lsb_v / slope / np.sqrt(12)
    errors = []
    for _ in range(400):
        pressure_pa = rng.uniform(low_pa, high_pa)
        read = curves.pressure(quantised(truth.voltage(pressure_pa)).astype(np.float32))
        errors.append((read - pressure_pa) / limit_pa)
    return rms(np.array(errors))


def truth_pressure_of(curves: Curves, voltage_v: float) -> Floats:
    """(n,) Pa at one voltage."""
    return curves.pressure(np.full(len(curves), voltage_v, dtype=np.float32)).astype(np.float64)


# Sensor models that the compensation does not assume, beside the one that it does


class Paper:
    """Lag and Prandtl–Ishlinskii plays, as the compensation assumes."""

    def __init__(self, sensors: int) -> None:
        self._lag = Lag(PAPER_DYNAMICS.rise_s, PAPER_DYNAMICS.fall_s)
        self._hysteresis = Hysteresis(PAPER_DYNAMICS, sensors)

    def __call__(self, pressure_pa: Floats, passed_s: float) -> Floats:
        return self._hysteresis.update(self._lag.update(pressure_pa, passed_s))


class Relays:
    """The same lag, then a classical Preisach operator, whose loops are others at every load.

    I. D. Mayergoyz, "Mathematical Models of Hysteresis and Their Applications" (2003), chapter 1.
    """

    LEVELS = 100
    SHARE = 0.2
    """Share of the reading that relays make; the rest follows at once."""

    def __init__(self, sensors: int) -> None:
        self._lag = Lag(PAPER_DYNAMICS.rise_s, PAPER_DYNAMICS.fall_s)
        levels_pa = (np.arange(self.LEVELS) + 0.5) * HIGHEST_PA / self.LEVELS
        up, down = np.tril_indices(self.LEVELS)
        self._up_pa, self._down_pa = levels_pa[up, None], levels_pa[down, None]
        # Most relays are narrow, and wide ones belong to high loads.
        weights = np.exp(-4 * (1 - levels_pa[down] / levels_pa[up])) * np.sqrt(levels_pa[up])
        self._weights_pa = self.SHARE * HIGHEST_PA * weights / weights.sum()
        self._on = np.zeros((len(up), sensors), dtype=bool)
        self._ends_pa = np.arange(self.LEVELS + 1) * HIGHEST_PA / self.LEVELS
        risen_pa = np.append(0.0, np.cumsum(np.bincount(up, self._weights_pa)))
        self._shown_pa = (1 - self.SHARE) * self._ends_pa + risen_pa

    def __call__(self, pressure_pa: Floats, passed_s: float) -> Floats:
        pressure_pa = self._lag.update(pressure_pa, passed_s)
        self._on |= pressure_pa >= self._up_pa
        self._on &= pressure_pa > self._down_pa
        shown_pa = (1 - self.SHARE) * pressure_pa + self._weights_pa @ self._on
        return np.asarray(np.interp(shown_pa, self._shown_pa, self._ends_pa))


class Creep:
    """A generalised Kelvin–Voigt solid: shares of a load show at once, in 0.15 s, and in 4 s."""

    TIMES_S = np.array([0.15, 4.0])[:, None]
    SHARES = np.array([0.25, 0.1])[:, None]

    def __init__(self, sensors: int) -> None:
        self._crept_pa = np.zeros((len(self.TIMES_S), sensors))

    def __call__(self, pressure_pa: Floats, passed_s: float) -> Floats:
        missing_pa = self.SHARES * pressure_pa - self._crept_pa
        self._crept_pa -= missing_pa * np.expm1(-passed_s / self.TIMES_S)
        return np.asarray((1 - self.SHARES.sum()) * pressure_pa + self._crept_pa.sum(axis=0))


class Quick:
    """Neither lag nor loops: nothing to compensate."""

    def __init__(self, sensors: int) -> None:
        pass

    def __call__(self, pressure_pa: Floats, passed_s: float) -> Floats:
        return pressure_pa


KINDS: dict[str, Callable[[int], Distortion]] = {
    "the paper's": Paper,
    "relays": Relays,
    "creep": Creep,
    "quick": Quick,
}


def apparent(kind: Callable[[int], Distortion], loads_pa: Floats, period_s: float) -> Floats:
    """Apparent pressure at every frame, (m, n) Pa, under loads (m, n), Pa, linear in between."""
    sensors, before_pa, shown = kind(loads_pa.shape[1]), loads_pa[0], []
    for load_pa in loads_pa:
        for part in range(1, PARTS + 1):
            shown_pa = sensors(before_pa + (load_pa - before_pa) * part / PARTS, period_s / PARTS)
        before_pa = load_pa
        shown.append(shown_pa)
    return np.array(shown)


# Dynamics


def cycles(seconds: float, nodes: int, rng: np.random.Generator) -> Floats:
    """(m, n) Pa: loads that go from one random turn to the next, every node at its own pace."""
    t_s = np.arange(0, seconds, PERIOD_S)
    loads = np.empty((len(t_s), nodes))
    for node in range(nodes):
        span_s = np.cumsum(rng.uniform(0.5, 4.0, int(seconds) + 4))
        turns = rng.uniform(0, 140e3, len(span_s))
        turns[::2] *= 0.2  # up and down, often near rest
        place = np.interp(t_s, span_s, np.arange(len(span_s)), left=0.0)
        start = np.minimum(place.astype(int), len(turns) - 2)
        share = 0.5 - 0.5 * np.cos(np.pi * (place - start))
        loads[:, node] = turns[start] + (turns[start + 1] - turns[start]) * share
    loads *= np.clip(t_s / 2.0, 0, 1)[:, None]  # nothing has touched the skin before
    return loads


def recorded(model: SensorModel, loads_pa: Floats) -> Floats:
    """(m, n) V: what the nodes measure under such loads, frame by frame."""
    sensor = Sensor(model, loads_pa.shape[1])
    return np.array([quantised(sensor.step(p, i * PERIOD_S)) for i, p in enumerate(loads_pa)])


def read(chain: PressureChain, voltage_v: Floats, tare_s: float = math.inf) -> Floats:
    """(m, n) Pa: a chain's readings of these voltages, tared at tare_s if it can be."""
    nodes = voltage_v.shape[1]
    valid, curves = np.ones(nodes, dtype=bool), chain.calibration.curves
    layout, tare_frame = Layout.grid(nodes, 0, 0, 7e-3, 5.5e-3), tare_s / PERIOD_S
    rows = []
    for i, v in enumerate(voltage_v.astype(np.float32)):
        rows.append(chain.update(v, valid, i * PERIOD_S)[0])
        if i >= tare_frame and chain.tracker and not chain.baseline.tared:
            take_tare(chain.baseline, curves, layout, ADC.lsb_v, RULES.contact_pa, ~valid, True)
    return np.array(rows)


def identified(model: SensorModel, calibration: Calibration, seed: int) -> Dynamics:
    """From cycles that load all taxels alike, on the calibrated skin."""
    loads_pa = cycles(TAUGHT_S, 1, np.random.default_rng([seed, 2]))
    voltage_v = recorded(model, np.repeat(loads_pa, len(calibration.curves), axis=1))
    pressure_pa = np.array([calibration.curves.pressure(v) for v in voltage_v.astype(np.float32)])
    t_s = np.arange(len(loads_pa), dtype=np.float64) * PERIOD_S
    return identify(t_s, loads_pa[:, 0], pressure_pa).dynamics


def off_by(known: Dynamics, factor: float) -> dict[str, Dynamics]:
    """Dynamics that are wrong by a factor, of sensors that have changed since."""
    lag = replace(known, rise_s=known.rise_s * factor, fall_s=known.fall_s * factor)
    weights = tuple(weight * factor for weight in known.weights)
    percent = f"{(factor - 1) * 100:+.0f} %"
    return {
        f"lag {percent}": lag,
        f"loops {percent}": replace(known, weights=weights),
        f"both {percent}": replace(lag, weights=weights),
    }


def dynamics(report: Report) -> tuple[dict[str, float], list[Floats]]:
    """Share of the rms error removed, by how well the sensors are known; and a node to draw."""
    before: list[float] = []
    after: dict[str, list[float]] = {}
    excerpt: list[Floats] = []
    for seed in range(SKINS):
        model = SensorModel(kind="paper", mismatch=MISMATCH, seed=seed)
        calibration = calibrated(model)
        known = identified(model, calibration, seed)
        held_out = cycles(CYCLES_S, NODES, np.random.default_rng([seed, 3]))
        voltage_v = recorded(model, held_out)
        static_pa = read(PressureChain(calibration, Baseline(NODES)), voltage_v)
        before.append(rms(static_pa - held_out))
        beliefs = {MATCHED: known}
        for factor in DRIFTED:
            beliefs |= off_by(known, factor)
        beliefs |= {
            "lag alone": replace(known, widths=(), weights=()),
            "loops alone": replace(known, most_gain=1.0),
        }
        for name, belief in beliefs.items():
            undoing = Compensator(belief, calibration.curves.range_pa)
            chain = PressureChain(calibration, Baseline(NODES), compensator=undoing)
            compensated_pa = read(chain, voltage_v)
            after.setdefault(name, []).append(rms(compensated_pa - held_out))
            excerpt = excerpt or [held_out[:, 0], static_pa[:, 0], compensated_pa[:, 0]]
    static_rms = rms(np.array(before))
    left = {name: rms(np.array(values)) for name, values in after.items()}
    removed = {name: 1 - value / static_rms for name, value in left.items()}
    report.table(
        ["sensors", "rms error, Pa", "compensated, Pa", "removed"],
        [[name, static_rms, left[name], removed[name]] for name in left],
    )
    return removed, excerpt


def others(report: Report) -> dict[str, float]:
    """Share of the rms error removed from sensors of other models."""
    rows, removed = [], {}
    for kind, sensors in KINDS.items():
        tries = np.array([tried(sensors, seed) for seed in range(OTHER_SKINS)])
        static_pa, paper_pa, identified_pa = tries.T
        known = np.isfinite(identified_pa)
        left_pa = np.where(known, identified_pa, static_pa)  # refused: nothing is undone
        removed[kind], paper = (1 - rms(left) / rms(static_pa) for left in (left_pa, paper_pa))
        rows.append([kind, rms(static_pa), int(np.sum(~known)), removed[kind], paper])
    report.table(
        ["sensors", "rms error, Pa", f"refused of {OTHER_SKINS}", "removed", "by the paper's"], rows
    )
    return removed


def tried(sensors: Callable[[int], Distortion], seed: int) -> tuple[float, float, float]:
    """Rms errors, Pa: static, undone by the paper's dynamics, by identified ones (NaN: refused)."""
    calibration = Calibration.default(PressureCurve.two_stage(), NODES)
    curve = calibration.curves[0]
    taught_pa = cycles(TAUGHT_S, 1, np.random.default_rng([seed, 2]))
    held_out_pa = cycles(CYCLES_S, NODES, np.random.default_rng([seed, 3]))
    taught_v, voltage_v = (
        quantised(curve.voltage(apparent(sensors, loads_pa, PERIOD_S)))
        for loads_pa in (taught_pa, held_out_pa)
    )

    def error_pa(known: Dynamics | None) -> float:
        undoing = Compensator(known, calibration.curves.range_pa) if known else None
        chain = PressureChain(calibration, Baseline(NODES), compensator=undoing)
        return rms(read(chain, voltage_v) - held_out_pa)

    t_s = np.arange(len(taught_pa), dtype=np.float64) * PERIOD_S
    try:
        identified_pa = error_pa(identify(t_s, taught_pa[:, 0], curve.pressure(taught_v)).dynamics)
    except CalibrationError:
        identified_pa = math.nan
    return error_pa(None), error_pa(PAPER_DYNAMICS), identified_pa


# Tare and drift


def swallowed(report: Report) -> int:
    """Steady contacts that read less than half of their load after an hour of following drift."""
    side = 3 * len(CONTACTS_PA)
    layout = Layout.grid(side * side, side, side, 7e-3, 5.5e-3)
    place = np.arange(side * side)
    pressed = (place % side % 3 == 1) & (place // side % 3 == 1)  # neighbours rest
    load_pa = np.where(pressed, np.array(CONTACTS_PA)[place % side // 3], 0.0)
    rows, total = [], 0
    for warming_v in (0.0, WARMING_V):
        model = SensorModel(mismatch=MISMATCH, warming_v=warming_v)
        chain = chain_of(TARED, calibrated(model, len(place)), None, layout)
        sensor = Sensor(model, len(place))
        for t_s in np.arange(0.0, STEADY_S, LOOK_S):
            voltage_v = quantised(sensor.step(load_pa * (t_s > 15.0), t_s)).astype(np.float32)
            read_pa = chain.update(voltage_v, np.ones(len(place), dtype=bool), t_s)[0]
        lost = pressed & (read_pa < 0.5 * load_pa)
        total += int(np.count_nonzero(lost))
        left = [np.median(read_pa[pressed & (load_pa == load)]) for load in CONTACTS_PA]
        rows.append([warming_v * 1e3, int(pressed.sum()), int(lost.sum()), *map(float, left)])
    report.table(
        ["warming, mV", "contacts", "swallowed", *(f"{load:g} Pa" for load in CONTACTS_PA)], rows
    )
    return total


def warming(report: Report) -> None:
    """Readings of a skin without contacts while it warms up and cools down."""
    rows = []
    for warming_v in (WARMING_V, 2 * WARMING_V, 4 * WARMING_V):
        model = SensorModel(mismatch=MISMATCH, warming_v=warming_v)
        calibration = calibrated(model)
        left = []
        for rules in (replace(RULES, drift_pa_per_min=0.0), RULES):
            chain = chain_of(TARED, calibration, None, rules=rules)
            sensor, valid = Sensor(model, NODES), np.ones(NODES, dtype=bool)
            reads = []
            for t_s in np.arange(0.0, 600.0, LOOK_S):
                voltage_v = quantised(sensor.step(np.zeros(NODES), t_s))
                reads.append(chain.update(voltage_v.astype(np.float32), valid, t_s)[0])
            left.append(rms(np.array(reads)))
        slope = 0.033e-3
        rows.append([warming_v * 1e3, 60 * 2 * np.pi / 600 * warming_v / slope, *left])
    report.table(["warming, mV", "fastest, Pa/min", "rms at rest, Pa", "drift followed, Pa"], rows)


# All together

CURVE, CALIBRATED, TARED, COMPENSATED = "one curve", "calibrated", "+ tare, drift", "+ dynamics"
CHAINS = (CURVE, CALIBRATED, TARED, COMPENSATED)


def chain_of(
    name: str,
    calibration: Calibration,
    known: Dynamics | None,
    layout: Layout | None = None,
    rules: RestRules = RULES,
) -> PressureChain:
    """One of the chains that are compared; each has what the ones before it have."""
    nodes = len(calibration.curves)
    layout = layout or Layout.grid(nodes, 0, 0, 7e-3, 5.5e-3)
    if name == CURVE:
        calibration = Calibration.default(PressureCurve.two_stage(), nodes)
    tracker = compensator = None
    if name in (TARED, COMPENSATED):
        tracker = DriftTracker(ADC.lsb_v, nodes_beside(layout, nodes), rules)
    if name == COMPENSATED:
        assert known is not None
        compensator = Compensator(known, calibration.curves.range_pa)
    return PressureChain(calibration, Baseline(nodes), tracker, compensator)


def used(seconds: float, rng: np.random.Generator) -> Floats:
    """(m, n) Pa: a skin that is handled for 15 s and then rests for 15 s, over and over."""
    t_s = np.arange(0, seconds, PERIOD_S)
    handled = np.clip(np.sin(2 * np.pi * (t_s - REST_S) / 30.0) * 8, 0, 1) * (t_s > REST_S)
    return np.asarray(cycles(seconds, NODES, rng) * handled[:, None])


def chains(report: Report) -> tuple[dict[str, float], dict[str, float]]:
    """Rms error, Pa, and time of a frame of 4096 nodes, s, of each chain."""
    errors: dict[str, list[float]] = {name: [] for name in CHAINS}
    for seed in range(SKINS):
        model = SensorModel(
            kind="paper", mismatch=MISMATCH, warming_v=WARMING_V, noise_v=1e-3, seed=seed
        )
        calibration = calibrated(model)
        known = identified(model, calibration, seed)
        rng = np.random.default_rng([seed, 4])
        loads_pa, preload_pa = used(2 * CYCLES_S, rng), rng.uniform(0, PRELOAD_PA, NODES)
        voltage_v = recorded(model, loads_pa + preload_pa)
        for name in CHAINS:
            read_pa = read(chain_of(name, calibration, known), voltage_v, TARE_S)
            after = round(REST_S / PERIOD_S)
            errors[name].append(rms((read_pa - loads_pa)[after:]))
    error_pa = {name: rms(np.array(values)) for name, values in errors.items()}

    layout = Layout.grid(BIG, 0, 0, 7e-3, 5.5e-3)
    calibration = Calibration.default(PressureCurve.two_stage(), BIG)
    subjects = {
        name: frames(chain_of(name, calibration, PAPER_DYNAMICS, layout)) for name in CHAINS
    }
    tracker = ContactTracker(layout, ContactThresholds(RULES.contact_pa, RULES.release_pa))
    times_s = medians_s({**subjects, CONTACTS: contacts_of(tracker, layout)}, ROUNDS)
    report.table(
        ["chain", "rms error, Pa", f"µs per frame, {BIG} nodes"],
        [[name, error_pa[name], times_s[name] * 1e6] for name in CHAINS]
        + [["contacts of that", "", times_s[CONTACTS] * 1e6]],
    )
    return error_pa, times_s


def frames(chain: PressureChain) -> Callable[[], object]:
    """Returns a function that feeds one frame of a large skin, all of whose voltages are new."""
    voltage_v = pressed_skin()
    valid, number = np.ones(BIG, dtype=bool), 0

    def feed() -> object:
        nonlocal number
        number += 1
        return chain.update(voltage_v[number % len(voltage_v)], valid, number * 20e-3)

    return feed


def contacts_of(tracker: ContactTracker, layout: Layout) -> Callable[[], object]:
    """Returns a function that finds the contacts of one frame of the same skin."""
    curves = Curves.of([PressureCurve.two_stage()] * BIG)
    status = np.zeros(BIG, dtype=np.uint8)
    readings = [Readings(curves.pressure(v), v, status) for v in pressed_skin()]
    number = 0

    def find() -> object:
        nonlocal number
        number += 1
        return tracker.update(readings[number % len(readings)], number * 20e-3)

    return find


def pressed_skin() -> list[NDArray[np.float32]]:
    """Frames of a large skin under a few contacts that come and go, (BIG,) V each."""
    skin = SimOptions().skin(BIG)
    curve = PressureCurve.two_stage()
    times_s = np.arange(64) * 20e-3
    return [
        quantised(curve.voltage(SCENES["presses"](t, skin))).astype(np.float32) for t in times_s
    ]


CONTACTS = "contacts"


def main() -> None:
    report = Report("pressure", "Error and run time of the pressure chain")
    ratios = static(report)
    removed, excerpt = dynamics(report)
    removed_others = others(report)
    lost = swallowed(report)
    warming(report)
    error_pa, times_s = chains(report)
    drifted = min(value for name, value in removed.items() if "%" in name)
    report.finish(
        picture(ratios, removed, excerpt, error_pa, times_s),
        rmse_over_quantisation=ratios["fitted"],
        hysteresis_removed=removed[MATCHED],
        hysteresis_removed_drifted=drifted,
        hysteresis_removed_relays=removed_others["relays"],
        hysteresis_removed_creep=removed_others["creep"],
        false_tare=lost,
        us_per_frame_4096=times_s[COMPENSATED] * 1e6,
        us_static_4096=times_s[CALIBRATED] * 1e6,
        us_contacts_4096=times_s[CONTACTS] * 1e6,
    )


def picture(
    ratios: dict[str, float],
    removed: dict[str, float],
    excerpt: list[Floats],
    error_pa: dict[str, float],
    times_s: dict[str, float],
) -> Figure:
    figure = Figure(figsize=(13, 4.5))
    left, middle, right = figure.subplots(1, 3, width_ratios=(3, 2, 2))
    count = min(len(excerpt[0]), round(25 / PERIOD_S))
    t_s = np.arange(count) * PERIOD_S
    styles = (("pressed", "0.6", 3.0), ("calibrated curve", "C3", 1.0), ("compensated", "C0", 1.0))
    for series, (label, colour, width) in zip(excerpt, styles, strict=True):
        left.plot(t_s, series[:count] / 1e3, color=colour, lw=width, label=label)
    left.set_xlabel("s")
    left.set_ylabel("kPa")
    left.set_title("A taxel with lag and hysteresis")
    left.legend(fontsize=8)
    names = list(removed)
    middle.barh(names, [100 * removed[name] for name in names], color="C0")
    middle.axvline(60, color="black", lw=1, ls=":")
    middle.invert_yaxis()
    middle.set_xlabel("% of the rms error removed")
    middle.set_title("What compensation knows of the sensors")
    for name in CHAINS:
        right.plot(times_s[name] * 1e6, error_pa[name] / 1e3, "o", label=name)
    right.set_xlim(left=0)
    right.set_ylim(bottom=0)
    right.set_xlabel(f"µs per frame of {BIG} nodes")
    right.set_ylabel("rms error, kPa")
    right.set_title("All errors together, by chain")
    right.legend(fontsize=8)
    for axes in (left, middle, right):
        axes.grid(alpha=0.3)
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
