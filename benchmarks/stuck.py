# SPDX-License-Identifier: Apache-2.0

"""Time until stuck nodes are found, and how often sound ones are reported as stuck.

`make bench-stuck`.

Simulated skins are touched for hours; of each, a few nodes are stuck at a random word. What they
send passes through the same stages as in the driver, without the line, at one frame per look of
the detector.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import islice

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.stuck import LOOK_S, StuckNodes
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.words.decode import Words

from .report import QUICK, Report, medians_s

SIDES = (4, 16) if QUICK else (4, 8, 16)
SCENES = ("press", "presses", "moving", "all", "hand")
SENSORS = {
    "ideal": "",
    "noisy": "&sensor=paper&mismatch=0.05&sensor_noise=0.002&warming=10",
}
SEEDS = range(2) if QUICK else range(3)
SECONDS = 120 if QUICK else 300
STUCK_SHARE = 1 / 16
CONTACT_PA = 1e3
COST_SIDES = (4, 16, 64)
COST_ROUNDS = 20


def main() -> None:
    report = Report("stuck", "Nodes that do not move: how soon they are found")
    rows, delays, false, sound_h = [], [], 0, 0.0
    for side in SIDES:
        for scene in SCENES:
            for sensors, options in SENSORS.items():
                runs = [Run(side, f"scene={scene}{options}", seed) for seed in SEEDS]
                found = [delay for run in runs for delay in run.delays_s]
                stuck = sum(run.stuck for run in runs)
                inner = sum(run.inner for run in runs)
                inner_found = sum(run.inner_found for run in runs)
                wrong = sum(run.false for run in runs)
                delays += found
                false += wrong
                sound_h += sum(run.sound_h for run in runs)
                median_s = float(np.median(found)) if found else float("nan")
                rows.append(
                    (
                        side * side,
                        scene,
                        sensors,
                        len(found) / stuck,
                        inner_found / inner if inner else float("nan"),
                        median_s,
                        wrong,
                    )
                )
    report.table(["nodes", "scene", "sensors", "found", "of inner ones", "median s", "false"], rows)
    costs = cost_us()
    report.table(["nodes", "µs per look"], list(costs.items()))
    report.finish(
        picture(delays),
        found=len(delays),
        false_alarms=false,
        sound_node_hours=sound_h,
        cost_us_4096=costs[4096],
    )


class Run:
    """One skin in one scene. delays_s: until each stuck node that was found had been found.

    inner: of the stuck nodes, those that have neighbours all around. false: sound nodes that were
    ever named. sound_h: node-hours without a fault.
    """

    def __init__(self, side: int, options: str, seed: int) -> None:
        nodes = side * side
        count = max(1, round(STUCK_SHARE * nodes))
        rng = np.random.default_rng([seed, nodes])
        numbers = (rng.permutation(nodes)[:count] + 1).tolist()
        url = f"sim://?seed={seed}&heartbeat=10&{options}&stuck={','.join(map(str, numbers))}"
        first_s: dict[int, float] = {}
        frames = round(SECONDS / LOOK_S)
        for t_s, named in islice(named_nodes(SimOptions.from_url(url), nodes), frames):
            for node in named:
                first_s.setdefault(node, t_s)
        inside = {node for node in numbers if all(0 < i < side - 1 for i in divmod(node - 1, side))}
        self.stuck, self.inner = count, len(inside)
        self.delays_s = [first_s[node] for node in numbers if node in first_s]
        self.inner_found = len(inside & first_s.keys())
        self.false = len(first_s.keys() - set(numbers))
        self.sound_h = (nodes - count) * SECONDS / 3600


def named_nodes(options: SimOptions, nodes: int) -> Iterator[tuple[float, list[int]]]:
    """Yield time, s, and the nodes reported as stuck, look by look, endlessly."""
    config = SkinConfig.of({"nodes": nodes, "frame_period_ms": LOOK_S * 1e3, "chip_us": 1.0})
    pipeline, stuck = Pipeline(config), StuckNodes(config.layout)
    nothing, no = np.zeros(nodes, dtype=np.float32), np.zeros(nodes, dtype=bool)
    sure = np.full(nodes, 100, dtype=np.float32)
    for frame in truth(options, Setup(config.spec)):
        words = Words(
            frame.active, frame.codes.astype(np.int32), nothing, sure, nothing, no, no, no, no, 0.0
        )
        pipeline.health.update(words)
        readings = pipeline.taxels.update(words, frame.start_s, pipeline.health)
        stuck.look(readings, frame.start_s, CONTACT_PA)
        yield frame.start_s, stuck.nodes


def cost_us() -> dict[int, float]:
    """Time of one look where all taxels change, µs, by the number of nodes."""
    costs = {}
    for side in COST_SIDES:
        nodes = side * side
        stuck = StuckNodes(Layout.grid(nodes, side, side, 0.007, 0.0055))
        rng, status = np.random.default_rng(0), np.zeros(nodes, dtype=np.uint8)
        looks = [_readings(rng, status) for _ in range(COST_ROUNDS)]

        def look_at_all(
            stuck: StuckNodes = stuck, looks: list[Readings] = looks, begin: float = 0.0
        ) -> None:
            began = time.monotonic()
            for number, readings in enumerate(looks):
                stuck.look(readings, began + number, CONTACT_PA)

        seconds = medians_s({"look": look_at_all}, 5)
        costs[nodes] = 1e6 * seconds["look"] / COST_ROUNDS
    return costs


def _readings(rng: np.random.Generator, status: NDArray[np.uint8]) -> Readings:
    """Readings with these status bits, and arbitrary pressures and voltages."""
    pressure_pa, voltage_v = rng.uniform(0, 1e5, (2, len(status))).astype(np.float32)
    return Readings(pressure_pa, voltage_v, status)


def picture(delays_s: list[float]) -> Figure:
    """Share of stuck nodes found, against time."""
    figure = Figure(figsize=(6, 3.5))
    axes = figure.subplots()
    axes.plot(np.sort(delays_s), np.arange(1, len(delays_s) + 1) / max(len(delays_s), 1))
    axes.set(xscale="log", xlabel="seconds of touching", ylabel="share of the nodes found")
    axes.grid(True, which="both", alpha=0.3)
    return figure


if __name__ == "__main__":
    main()
