# SPDX-License-Identifier: Apache-2.0

"""Error and run time of the pressure chain: `make bench-pressure`.

Skins of simulated sensors (docs/paper.md), each taxel with a curve of its own, behind 10-bit
converters. Errors are of data that was not used to calibrate.

- static: curves fitted to a staircase of loads, for ideal sensors at random pressures; the error is
  compared with that of the quantisation alone, LSB/√12 on each taxel's own slope, stage by stage.
- tare: contacts that stay for an hour while drift is followed; one counts as swallowed if it reads
  less than half of its load at the end. Also, the drift left on a warming skin without contacts.
- sigma: how often the true pressure is within ±1 σ of a reading, under loads that stand still, of
  sensors that drift and are noisy, ideal, force sensing resistors, and the paper's with their loop,
  calibrated by loads up and down; hour by hour.
- chains: everything at once, on skins that are mounted with up to 3 kPa of preload, for each chain
  from the plain curve on: error, and time of a frame in which all nodes transmit.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.calibrating.load_points import LoadPoints
from tactile_cdma.calibrating.skin_fit import fit_skin
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.frames import words_memory, words_of
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import LOOK_S, Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.contact import ContactThresholds, ContactTracker
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.taxels import Readings, Taxels
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES
from tactile_cdma.sim.sensor import Sensor, SensorModel
from tactile_cdma.words.health import NodeHealth

from . import style
from .report import QUICK, Report, in_turn, medians_s, rows_of

Floats = NDArray[np.float64]

ADC = AdcScale()
PERIOD_S = 12.8e-3
NODES = 16 if QUICK else 64
SKINS = 2 if QUICK else 8
CYCLES_S = 20.0 if QUICK else 120.0
MISMATCH = 0.05
CALIBRATION_PA = np.concatenate([np.arange(0.0, 50e3, 2.5e3), np.arange(50e3, 140.1e3, 5e3)])
CONTACTS_PA = (250.0, 350.0, 500.0, 1e3, 5e3, 20e3, 49e3, 70e3, 130e3)
WARMING_V = 0.003
PRELOAD_PA = 3e3
TARE_S, REST_S = 5.0, 10.0
"""A mounted skin is tared, and first touched."""
BIG = 4096
ROUNDS = 9 if QUICK else 31
HOURS = 1.0 if QUICK else 3.0
STEADY_S = 300.0 if QUICK else 3600.0
RULES = RestRules(drift_pa_per_min=60.0, contact_pa=1e3, release_pa=500.0)


def quantised(voltage_v: Floats) -> Floats:
    """Return the voltage as the node's converter reads it."""
    return ADC.voltage(ADC.code(voltage_v))


def rms(error: Floats) -> float:
    """Return the root of the mean square; NaN is no reading: before the start of its curve."""
    return float(np.sqrt(np.nanmean(np.square(error))))


def calibrated(model: SensorModel, nodes: int = NODES) -> Calibration:
    """Return a calibration of such a skin, from a staircase of settled loads."""
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


# Loads


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


class Chain:
    """A skin whose nodes all transmit, from the words of a frame to its readings."""

    def __init__(self, calibration: Calibration, layout: Layout, rules: RestRules) -> None:
        nodes = len(calibration.curves)
        tracker = DriftTracker(ADC, nodes_beside(layout, nodes), rules)
        chain = PressureChain(calibration, Baseline(nodes), tracker)
        self.taxels = Taxels(nodes, ADC, chain, layout, 1.0)
        self.health = NodeHealth(FrameSpec(nodes=nodes, chip_s=1e-8, frame_period_s=1.0))

    def update(self, words: NDArray[np.uint8], t_s: float) -> NDArray[np.float32]:
        """Return pressures, (n,) Pa; words: see spoken."""
        return self.taxels.update(words, t_s, self.health).pressure_pa


def spoken(voltage_v: Floats | NDArray[np.float32]) -> NDArray[np.uint8]:
    """Words of nodes that measure such voltages, (n,), clear and without doubt, as C keeps them."""
    memory = words_memory(voltage_v.size)
    words = words_of(memory, voltage_v.size, 0.0)
    memory[:] = 0
    words.active[:], words.codes[:] = True, ADC.code(voltage_v)
    words.amplitude_v[:], words.rho[:], words.margin[:] = 0.3, 100.0, 1.0
    return memory


def read(chain: Chain, voltage_v: Floats, tare_s: float = math.inf) -> Floats:
    """(m, n) Pa: a chain's readings of these voltages, tared at tare_s if it can be."""
    tare_frame, taxels, rows = tare_s / PERIOD_S, chain.taxels, []
    for i, v in enumerate(voltage_v):
        rows.append(chain.update(spoken(v), i * PERIOD_S))
        follows = taxels.chain.tracker.rules.drift_pa_per_min > 0
        if i >= tare_frame and follows and not taxels.baseline.tared:
            taxels.tare(RULES.contact_pa, force=True)
    return np.array(rows)


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
        chain = chain_of(TARED, calibrated(model, len(place)), layout)
        sensor = Sensor(model, len(place))
        for t_s in np.arange(0.0, STEADY_S, LOOK_S):
            read_pa = chain.update(spoken(sensor.step(load_pa * (t_s > 15.0), t_s)), t_s)
        lost = pressed & ~(read_pa >= 0.5 * load_pa)
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
            chain = chain_of(TARED, calibration, rules=rules)
            sensor = Sensor(model, NODES)
            reads = []
            for t_s in np.arange(0.0, 600.0, LOOK_S):
                reads.append(chain.update(spoken(sensor.step(np.zeros(NODES), t_s)), t_s))
            left.append(rms(np.array(reads)))
        slope = 0.033e-3
        rows.append([warming_v * 1e3, 60 * 2 * np.pi / 600 * warming_v / slope, *left])
    report.table(["warming, mV", "fastest, Pa/min", "rms at rest, Pa", "drift followed, Pa"], rows)


# How sure


def settled(model: SensorModel, pieces: int) -> Calibration:
    """Return a calibration of such a skin, from loads up and down that settled, drift apart."""
    sensor = Sensor(replace(model, warming_v=0.0), NODES)
    steps_pa = np.concatenate([CALIBRATION_PA, CALIBRATION_PA[-2::-1]])
    voltage_v = quantised(
        np.array([sensor.step(np.full(NODES, p), 10.0 * i) for i, p in enumerate(steps_pa)])
    )
    loads, numbers = np.meshgrid(steps_pa, np.arange(1, NODES + 1), indexing="ij")
    line = np.arange(loads.size)
    points = LoadPoints(numbers.ravel(), loads.ravel(), voltage_v.ravel(), line, "staircase")
    fit = fit_skin(points, NODES, ADC, pieces)
    assert not fit.refused, fit.refused
    curves = Curves.of([fit.curves[node] for node in range(1, NODES + 1)])
    return Calibration(curves, np.zeros(NODES, dtype=bool), "bench")


def standing(seconds: float, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """(m, n) Pa: loads that stand still for 3 to 60 s, for 2 minutes; then the skin rests as long.

    And (m, n) bool, where one is about to end. Light ones are as frequent as heavy ones; one of
    fifty stays for 15 minutes.
    """
    times_s = np.arange(0.0, seconds, LOOK_S)
    loads_pa, ends = np.zeros((len(times_s), NODES)), np.zeros((len(times_s), NODES), dtype=bool)
    for node in range(NODES):
        at_s = 20.0  # after the tare
        while at_s < seconds - 1.0:
            stays, rests = rng.random() < 0.02, at_s % 240.0 > 120.0 or rng.random() < 0.3
            until_s = at_s + (900.0 if stays and not rests else rng.uniform(3.0, 60.0))
            until_s = min(until_s, seconds - 1.0)
            load_pa = 0.0 if rests else RULES.contact_pa * math.exp(rng.uniform(0, math.log(125)))
            first, last = round(at_s / LOOK_S), round(until_s / LOOK_S)
            loads_pa[first:last, node] = load_pa
            ends[last - 1, node] = load_pa > 0 and until_s - at_s > 2.5
            at_s = until_s
    return loads_pa, ends


def sigma(report: Report) -> float:
    """Share of the true pressures within ±1 σ of what is read."""
    rows, every = [], list[NDArray[np.bool_]]()
    for kind, pieces in (("ideal", 2), ("fsr", 0), ("paper", 2)):
        hits: list[tuple[Floats, NDArray[np.bool_], Floats]] = []
        for seed in range(max(1, SKINS // 2)):
            model = SensorModel(
                kind=kind, mismatch=MISMATCH, warming_v=WARMING_V, noise_v=1e-3, seed=seed
            )
            chain, rng = chain_of(TARED, settled(model, pieces)), np.random.default_rng([seed, 7])
            taxels, sensor = chain.taxels, Sensor(model, NODES)
            taxels.with_sigma = True
            loads_pa, ends = standing(HOURS * 3600.0, rng)
            preload_pa = rng.uniform(0, PRELOAD_PA, NODES)
            for i, load_pa in enumerate(loads_pa):
                t_s = i * LOOK_S
                words = spoken(sensor.step(load_pa + preload_pa, t_s))
                readings = taxels.update(words, t_s, chain.health)
                if t_s == TARE_S:
                    taxels.tare(RULES.contact_pa, force=True)
                if not ends[i].any() or readings.sigma_pa is None:
                    continue
                read_pa, sigma_pa = readings.pressure_pa[ends[i]], readings.sigma_pa[ends[i]]
                known = np.isfinite(sigma_pa)
                inside = np.abs(read_pa - load_pa[ends[i]]) <= sigma_pa
                hits.append((load_pa[ends[i]][known], inside[known], sigma_pa[known]))
        load_pa, inside, sigma_pa = (np.concatenate(each) for each in zip(*hits, strict=True))
        every.append(inside)
        parts = [load_pa < 10e3, (load_pa >= 10e3) & (load_pa < 50e3), load_pa >= 50e3]
        shares = [float(inside[part].mean()) for part in parts]
        rows.append([kind, len(inside), float(np.median(sigma_pa)), *shares, float(inside.mean())])
    report.table(
        ["sensor", "loads", "σ, Pa", "within, 1 to 10 kPa", "to 50", "to 125", "all"], rows
    )
    return float(np.mean([inside.mean() for inside in every]))


# All together

CURVE, CALIBRATED, TARED = CHAINS = "one curve", "calibrated", "+ tare, drift"


def chain_of(
    name: str,
    calibration: Calibration,
    layout: Layout | None = None,
    rules: RestRules = RULES,
) -> Chain:
    """Return one of the chains that are compared; each has what the ones before it have."""
    nodes = len(calibration.curves)
    layout = layout or Layout.grid(nodes, 0, 0, 7e-3, 5.5e-3)
    if name == CURVE:
        calibration = Calibration.default(PressureCurve.two_stage(), nodes)
    if name != TARED:  # no reading is off rest, either
        rules = replace(rules, drift_pa_per_min=0.0, contact_pa=math.inf)
    return Chain(calibration, layout, rules)


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
        rng = np.random.default_rng([seed, 4])
        loads_pa, preload_pa = used(2 * CYCLES_S, rng), rng.uniform(0, PRELOAD_PA, NODES)
        voltage_v = recorded(model, loads_pa + preload_pa)
        for name in CHAINS:
            read_pa = read(chain_of(name, calibration), voltage_v, TARE_S)
            after = round(REST_S / PERIOD_S)
            errors[name].append(rms((read_pa - loads_pa)[after:]))
    error_pa = {name: rms(np.array(values)) for name, values in errors.items()}

    layout, frames = Layout.grid(BIG, 0, 0, 7e-3, 5.5e-3), pressed_skin()
    calibration = Calibration.default(PressureCurve.two_stage(), BIG)
    chained = {name: chain_of(name, calibration, layout).update for name in CHAINS}
    tracker = ContactTracker(layout, ContactThresholds(RULES.contact_pa, RULES.release_pa))
    status = np.zeros(BIG, dtype=np.uint8)
    readings = [Readings(calibration.curves.pressure(v), v, status) for v in frames]
    words = [spoken(v) for v in frames]
    subjects = {name: in_turn(each, words) for name, each in chained.items()}
    times_s = medians_s(
        {**subjects, CONTACTS: in_turn(tracker.update, readings)}, ROUNDS, clock=time.process_time
    )
    report.table(
        ["chain", "rms error, Pa", f"µs per frame, {BIG} nodes"],
        [[name, error_pa[name], times_s[name] * 1e6] for name in CHAINS]
        + [["contacts of that", "", times_s[CONTACTS] * 1e6]],
    )
    return error_pa, times_s


def pressed_skin() -> list[NDArray[np.float32]]:
    """Yield frames of a large skin under a few contacts that come and go, (BIG,) V each."""
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
    lost = swallowed(report)
    warming(report)
    coverage = sigma(report)
    _, times_s = chains(report)
    report.finish(
        picture(report.tables),
        rmse_over_quantisation=ratios["fitted"],
        false_tare=lost,
        sigma_coverage=coverage,
        us_per_frame_4096=times_s[TARED] * 1e6,
        us_static_4096=times_s[CALIBRATED] * 1e6,
        us_contacts_4096=times_s[CONTACTS] * 1e6,
    )


def picture(tables: list[list[list[Any]]]) -> Figure:
    """Draw the error of each chain, and what following drift is worth."""
    chains = rows_of(tables, "chain")[: len(CHAINS)]
    warm = next(table[1:] for table in tables if table[0][1] == "fastest, Pa/min")
    figure = style.sheet(380)
    errors, drifts = figure.subplots(1, 2)
    names, error_kpa = [row[0] for row in chains], [row[1] / 1e3 for row in chains]
    for bar, row in zip(errors.bar(names, error_kpa, color=style.BLUE), chains, strict=True):
        place = bar.get_x() + bar.get_width() / 2, bar.get_height()
        text = f"{row[1] / 1e3:.1f} kPa\n{row[2]:.0f} µs"
        errors.annotate(text, place, ha="center", va="bottom")
    errors.set(ylabel="rms error, kPa", ylim=(0, 1.25 * max(error_kpa)))
    errors.set_title(f"All errors together; time for {BIG} nodes")
    at = np.arange(len(warm))
    for shift, column, name in ((-0.2, 2, "as it is"), (0.2, 3, "drift followed")):
        drifts.bar(at + shift, [row[column] for row in warm], 0.4, label=name)
    drifts.set_xticks(at, [f"{row[1]:.0f}" for row in warm])
    drifts.set(
        xlabel="fastest drift, Pa/min", ylabel="rms at rest, Pa", title="Warming by 3, 6, 12 mV"
    )
    drifts.legend()
    for axes in (errors, drifts):
        axes.grid(axis="x", visible=False)
    return figure


if __name__ == "__main__":
    main()
