# SPDX-License-Identifier: Apache-2.0

"""Skin frames per second of CPU time against environments: `make bench-batch`.

A skin of 4 × 6 taxels in numpy: SkinBatch of given pressures, ideal or with the paper's lag and
hysteresis, and of spheres with forces, pressed by BatchCover. Beside it the one-by-one path, in
which Skin.step lets a simulated skin, line, digitizer and decoder make each frame; the same presses
go through both, and what differs in words, pressure or status is counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from operator import getitem
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tactile_cdma import Skin
from tactile_cdma.sim import BatchCover, SkinBatch, Sphere

from .report import QUICK, Report, medians_s

SKIN: dict[str, Any] = {"nodes": 24, "rows": 4, "columns": 6, "pitch_mm": 5.0, "taxel_mm": 5.0}
RATES: dict[str, dict[str, Any]] = {
    "62 Hz": {"frame_period_ms": 16.0},
    "100 Hz": {"frame_period_ms": 10.0, "chip_us": 20.0, "samples_per_chip": 1},
}
SIMULATOR = "sim://?scene=external&speed=0&noise=0&nodes=24&rows=4&columns=6&pitch_mm=5"
SENSORS = {"ideal": "", "lag and hysteresis": "&sensor=paper&mismatch=0.03&dead=7&heartbeat=20"}
BALL = Sphere(radius_m=0.012, position_m=(0.0, 0.0, 0.0))
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
    report.finish(
        picture(found, one_by_one_hz),
        frames_per_s=round(shown["float64"]),
        frames_per_s_float32=round(shown["float32"]),
        frames_per_s_paper=round(shown["float64, lag and hysteresis"]),
        frames_per_s_pressed=round(shown["float32, pressed"]),
        one_by_one_per_s=round(one_by_one_hz),
        against_chain_frames=compared,
        against_chain_wrong=wrong,
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
                cover, state = BatchCover(skin.layout), batch.begin(np.zeros(()), heard=False)
                place_m = np.array([[0.0, 0.0, 0.05]])
                for _ in range(STEPS):
                    place_m += rng.normal(0, 4e-4, (1, 3))
                    place_m = np.clip(place_m, [-0.015, -0.01, 0.009], [0.015, 0.01, 0.0125])
                    state, ours = batch.step(state, cover.pressure_pa(BALL, place_m))
                    begun_s = time.process_time()
                    ball = Sphere(radius_m=BALL.radius_m, position_m=place_m[0].tolist())
                    frame = skin.step(ball)
                    took_s += time.process_time() - begun_s
                    spoke = frame.active
                    same = ours.active[0] == spoke
                    same &= ~spoke | (ours.codes[0] == frame.codes)
                    same &= ours.status[0] == frame.status
                    same &= (ours.pressure_pa[0] == frame.pressure_pa) | np.isnan(frame.pressure_pa)
                    same &= np.isnan(ours.pressure_pa[0]) == np.isnan(frame.pressure_pa)
                    wrong += int(np.count_nonzero(~same))
                    compared += 1
    return wrong, compared, compared / took_s


def picture(found: dict[int, dict[str, float]], one_by_one_hz: float) -> Figure:
    figure = Figure(figsize=(7, 3.5))
    axes = figure.subplots()
    for number, kind in enumerate(found[SHOWN]):
        values = [rates[kind] for rates in found.values()]
        axes.loglog(list(found), values, "o-", color=f"C{number}", label=f"SkinBatch, {kind}")
    axes.axhline(one_by_one_hz, color="0.4", ls="--", label="Skin.step, one by one")
    axes.set(xlabel="environments", ylabel="skin frames per s of CPU time")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3, which="both")
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
