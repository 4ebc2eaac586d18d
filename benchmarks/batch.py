# SPDX-License-Identifier: Apache-2.0

"""Skin frames per second of CPU time against environments: `make bench-batch`.

A skin of 4 × 6 taxels in numpy: SkinBatch of given pressures, ideal or with the paper's lag and
hysteresis, and of spheres with forces, pressed by BatchCover. Beside it the one-by-one path, in
which Skin.step lets a simulated skin, line, digitizer and decoder make each frame; the same presses
go through both, and what differs in words, pressure or status is counted. Then pressing with a
force over the step that follows it, in numpy, torch and JAX, where these are installed; and the
options of the simulator that differ between environments, and those that are taken but do nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from operator import getitem
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tactile_cdma import Skin, SpecError
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves
from tactile_cdma.sim import BatchCover, Box, Capsule, Cylinder, SkinBatch, Sphere
from tactile_cdma.sim.indenters import Bounded
from test.support.batch_options import OF_THE_LINE, ONE_BY_ONE
from test.support.calibrations import write_calibration

from .report import QUICK, Report, medians_s
from .style import sheet

SKIN: dict[str, Any] = {"nodes": 24, "rows": 4, "columns": 6, "pitch_mm": 5.0, "taxel_mm": 5.0}
RATES: dict[str, dict[str, Any]] = {
    "62 Hz": {"frame_period_ms": 16.0},
    "100 Hz": {"frame_period_ms": 10.0, "chip_us": 20.0, "samples_per_chip": 2},
}
SIMULATOR = "sim://?scene=external&speed=0&noise=0&nodes=24&rows=4&columns=6&pitch_mm=5"
SENSORS = {"ideal": "", "lag and hysteresis": "&sensor=paper&mismatch=0.03&heartbeat=20"}
ASKED = 3
"""First frames, in which a driver asks all nodes to speak: a batch has them behind it."""
BALL = Sphere(radius_m=0.012, position_m=(0.0, 0.0, 0.0))
THINGS: dict[str, Bounded] = {
    "sphere": Sphere(radius_m=0.02, position_m=(0, 0, 0)),
    "box": Box(size_m=(0.01, 0.02, 0.012), position_m=(0, 0, 0)),
    "capsule": Capsule(radius_m=0.006, length_m=0.02, position_m=(0, 0, 0)),
    "cylinder": Cylinder(radius_m=0.006, length_m=0.03, position_m=(0, 0, 0)),
}
LIBRARIES = "numpy", "torch", "jax"
FORCED = "sim://?sensor=paper&sensor_noise=0.004"
"""The skin of 4 × 4 taxels on which forces are timed."""
ENVS = (1, 64, 1024) if QUICK else (1, 16, 64, 256, 1024, 4096, 16384)
SHOWN = 1024
"""Environments of the last line's figures."""
STEPS = 150 if QUICK else 1500
"""Frames of every kind of skin that are compared with the chain."""
ROUNDS = 3 if QUICK else 15


def main() -> None:
    report = Report("batch", "Skin frames of 24 taxels per second of CPU time, numpy")
    wrong, compared, one_by_one_hz = against_chain()
    found = {envs: rates(envs) for envs in ENVS}
    kinds = list(found[SHOWN])
    report.table(["environments", *kinds], [[envs, *found[envs].values()] for envs in ENVS])
    headers = ["compared with the chain", "frames", "wrong", "one by one, frames/s"]
    report.table(headers, [["codes, pressure, status", compared, wrong, one_by_one_hz]])
    shown = found[SHOWN]
    over_step = {library: force_over_step(library) for library in LIBRARIES}
    kinds = [f"{name}{how}" for name in THINGS for how in ("", ", tilted")]
    rows = [[kind, *(over_step[library].get(kind, "") for library in LIBRARIES)] for kind in kinds]
    report.table(["time of a force over a step", *LIBRARIES], rows)
    differing, ignored = options_that_differ()
    report.finish(
        picture(found, one_by_one_hz),
        frames_per_s=round(shown["float64"]),
        frames_per_s_float32=round(shown["float32"]),
        frames_per_s_paper=round(shown["float64, lag and hysteresis"]),
        frames_per_s_pressed=round(shown["float32, pressed"]),
        one_by_one_per_s=round(one_by_one_hz),
        against_chain_frames=compared,
        against_chain_wrong=wrong,
        **{f"force_over_step_{name}": worst(found) for name, found in over_step.items()},
        randomised=differing,
        ignored=ignored,
    )


def rates(envs: int) -> dict[str, float]:
    """Return frames per second of CPU time in so many environments, by kind."""
    subjects: dict[str, Callable[[], object]] = {}
    rng = np.random.default_rng(envs)
    config = Skin("sim://", **SKIN, **RATES["62 Hz"]).config
    cover = BatchCover(config.layout)
    for kind, name, url in (
        (np.float64, "float64", SENSORS["ideal"]),
        (np.float32, "float32", SENSORS["ideal"]),
        (np.float64, "float64, lag and hysteresis", SENSORS["lag and hysteresis"]),
    ):
        batch = SkinBatch(config, envs, f"{SIMULATOR}{url}")
        pressed_pa = rng.uniform(0, 6e4, (2, envs, 24)).astype(kind)
        subjects[name] = running(batch, partial(getitem, pressed_pa))
    places_m = rng.uniform(-0.01, 0.01, (2, envs, 3)).astype(np.float32)
    force_n = rng.uniform(0.1, 5, (2, envs)).astype(np.float32)
    batch = SkinBatch(config, envs, SIMULATOR)

    def press(turn: int) -> object:
        return cover.pressure_pa(BALL, places_m[turn], force_n=force_n[turn])

    subjects["float32, pressed"] = running(batch, press)
    took_s = medians_s(subjects, ROUNDS, clock=time.process_time)
    return {name: envs / each_s for name, each_s in took_s.items()}


def running(batch: SkinBatch, pressures: Callable[[int], object]) -> Callable[[], None]:
    """Return a function that makes one frame of all environments, of two loads by turns."""
    state, turn = batch.begin(pressures(0)), 0

    def step() -> None:
        nonlocal state, turn
        state, _ = batch.step(state, pressures(turn))
        turn = 1 - turn

    return step


def against_chain() -> tuple[int, int, float]:
    """Taxels' readings that differ from the chain's, frames compared, frames/s of the latter."""
    wrong = compared = 0
    took_s = 0.0
    for rate in RATES.values():
        for url in SENSORS.values():
            rng = np.random.default_rng(compared)
            port = f"{SIMULATOR}{url}"
            with Skin(port, drift_pa_per_min=0.0, **SKIN, **rate) as skin:
                batch = SkinBatch(skin.config, 1, port, delay_frames=0)
                cover, state = BatchCover(skin.layout), batch.begin(np.zeros(()))
                place_m = np.array([[0.0, 0.0, 0.05]])
                for number in range(STEPS):
                    place_m += rng.normal(0, 4e-4, (1, 3))
                    place_m = np.clip(place_m, [-0.015, -0.01, 0.009], [0.015, 0.01, 0.0125])
                    state, ours = batch.step(state, cover.pressure_pa(BALL, place_m))
                    begun_s = time.process_time()
                    ball = Sphere(radius_m=BALL.radius_m, position_m=place_m[0].tolist())
                    frame = skin.step(ball)
                    took_s += time.process_time() - begun_s
                    if number < ASKED:
                        continue
                    spoke = frame.active
                    same = ours.active[0] == spoke
                    same &= ~spoke | (ours.codes[0] == frame.codes)
                    same &= ours.status[0] == frame.status
                    same &= (ours.pressure_pa[0] == frame.pressure_pa) | np.isnan(frame.pressure_pa)
                    same &= np.isnan(ours.pressure_pa[0]) == np.isnan(frame.pressure_pa)
                    wrong += int(np.count_nonzero(~same))
                    compared += 1
    return wrong, compared, compared / took_s


def force_over_step(library: str) -> dict[str, float]:
    """Time of BatchCover with a force over that of SkinBatch.step, by object; none: no library.

    Of 1,024 environments on one core, float32; JAX compiles both.
    """
    try:
        numbers = import_module("jax.numpy" if library == "jax" else library)
    except ImportError:
        print(f"not measured: pip install {library}")
        return {}
    if library == "torch":
        numbers.set_num_threads(1)
    jax = import_module("jax") if library == "jax" else None

    def compiled(function: Callable[..., object]) -> Callable[..., object]:
        return jax.jit(function) if jax else function  # type: ignore[no-any-return]

    def timed(function: Callable[..., object], *arrays: Any) -> Callable[[], object]:
        fast = compiled(function)
        return (lambda: jax.block_until_ready(fast(*arrays))) if jax else (lambda: fast(*arrays))

    rng, skin = np.random.default_rng(0), Skin(FORCED, nodes=16)
    cover, batch = BatchCover(skin.layout), SkinBatch(skin.config, SHOWN, FORCED)
    draws = rng.uniform(-5e-3, 5e-3, (SHOWN, 3)), rng.standard_normal((SHOWN, 4))
    drawn = *draws, np.full(SHOWN, 2.0), rng.standard_normal((SHOWN, 16))
    place_m, turned, force_n, noise = (numbers.asarray(each.astype(np.float32)) for each in drawn)
    state = batch.begin(place_m)
    pressure_pa = cover.pressure_pa(THINGS["sphere"], place_m, None, force_n)
    subjects = {"step": timed(batch.step, state, pressure_pa, noise)}
    for name, thing in THINGS.items():
        press = partial(cover.pressure_pa, thing)
        subjects[name] = timed(lambda p, f, press=press: press(p, None, f), place_m, force_n)
        subjects[f"{name}, tilted"] = timed(press, place_m, turned, force_n)
    took_s = medians_s(subjects, ROUNDS, clock=time.process_time)
    return {name: each_s / took_s["step"] for name, each_s in took_s.items() if name != "step"}


def worst(found: dict[str, float]) -> float | str:
    """Return the greatest ratio of the objects that are not tilted."""
    return max((found[name] for name in THINGS if name in found), default="not_installed")


def options_that_differ() -> tuple[int, int]:
    """Count options of which environments differ, and those that are taken and do nothing."""
    config = Skin("sim://", **SKIN, **RATES["62 Hz"]).config
    with TemporaryDirectory() as folder:
        own = Path(folder, "own.yaml")
        pressure_pa = np.array([0.0, 5e3, 2e4, 1e5])[:, None] + np.zeros(24)
        voltage_v = np.array([0.4, 1.0, 2.0, 2.9])[:, None] + np.zeros(24)
        calibration = Calibration(Curves(pressure_pa, voltage_v), np.zeros(24, bool))
        write_calibration(own, calibration, AdcScale(10, 3.3))
        pairs = [
            [f"sim://?{query.format(own=own)}" for query in both] for both in ONE_BY_ONE.values()
        ]
        differing = sum(differs(SkinBatch(config, 2, urls)) for urls in pairs)
    taken = 0
    for option in OF_THE_LINE:
        try:
            SkinBatch(config, 2, ["sim://", f"sim://?{option}"])
            taken += 1
        except SpecError:
            pass
    return differing, taken + len(ONE_BY_ONE) - differing


def differs(batch: SkinBatch) -> bool:
    """Tell whether two skins under the same loads, and with the same noise, ever differ."""
    rng, state = np.random.default_rng(4), batch.begin(np.zeros(()))
    for number in range(80):
        if number % 10 == 0:
            pressed_pa = np.repeat(rng.uniform(0, 8e4, (1, 24)), 2, axis=0)
        state, frame = batch.step(state, pressed_pa, np.repeat(rng.normal(size=(1, 24)), 2, axis=0))
        if any(not np.array_equal(a[0], a[1], equal_nan=a.dtype.kind == "f") for a in frame):
            return True
    return False


def picture(found: dict[int, dict[str, float]], one_by_one_hz: float) -> Figure:
    figure = sheet(430)
    axes = figure.subplots()
    for number, kind in enumerate(found[SHOWN]):
        values = [rates[kind] for rates in found.values()]
        axes.loglog(list(found), values, "o-", color=f"C{number}", label=f"SkinBatch, {kind}")
    axes.axhline(one_by_one_hz, color="0.4", ls="--", label="Skin.step, one by one")
    axes.set(xlabel="environments", ylabel="skin frames per s of CPU time")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
