# SPDX-License-Identifier: Apache-2.0

"""How many nodes speak, by the rules that their memories choose from: `make bench-speaking`.

Sensors of the paper with 1 mV rms of noise, converters of 10 bits, a threshold of 1 LSB. "fixed" is
`rest` with a rest that never follows, as of firmware before. Shares are of the nodes in a frame,
beside those whose heartbeat it is. `hug`: two arms and a chest, breathing, on 4,000 taxels at 10 mm
and 50 Hz; `walk`: somebody walks on these; `day`: nothing touches 400 taxels, whose voltages drift
by up to 2 % of the range and back in 24 hours, in frames of 1 s (QUICK=1: 10 s). "crowded" is the
share of frames in which more nodes speak than a frame of sparse_skin.yaml holds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.base.arrays import Floats
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.framing.load import capacity
from tactile_cdma.hardware.node_memory import CHANGE, REST, usual_follow, usual_heartbeat
from tactile_cdma.readings.calibration import AdcScale
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.nodes import NodeRules
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.scene import Scene, SkinGeometry

from .report import QUICK, ROOT, Report
from .style import sheet

Codes = NDArray[np.int64]

THRESHOLD = 1
NEVER = 1 << 40
"""Frames in which a rest follows that does not."""
FIXED = "fixed"
SECONDS = 16.0 if QUICK else 40.0
HUG_S, HOLD_S, GRIP_S = 8.0, 6.0, 0.6
"""Time from one hug to the next, of one, and in which it gets its force; chosen."""
HUG_PA = 12e3
STEP_S, CONTACT_S = 0.55, 0.65
"""Time from one step to the next, and that a foot is on the floor: an easy pace."""
FOOT_PA = 90e3
DAY_S = 86_400.0
DRIFT = 0.02
"""Share of the range by which voltages drift; that of issue 45."""
DRIFTING, FRAME_S = 400, 10.0 if QUICK else 1.0
NOISE_V = 1e-3


def main() -> None:
    report = Report("speaking", "share of the nodes that speak in a frame, by rule")
    config = torso()
    most, rows = capacity(config.spec), []
    found: dict[tuple[str, str], Floats] = {}
    for name, spec, codes in (
        ("hug", config.spec, touched(config, hug)),
        ("walk", config.spec, touched(config, walk)),
        ("day", replace(config.spec, frame_period_s=FRAME_S), day()),
    ):
        for rule, shares in speaking(spec, codes).items():
            found[name, rule] = shares
            crowded = float(np.mean(shares * config.spec.nodes > most))
            rows.append((name, rule, shares.mean(), shares.max(), crowded))
    report.table(("scene", "rule", "mean share", "largest", "crowded"), rows)
    means = {key: float(shares.mean()) for key, shares in found.items()}
    report.finish(
        figure(found),
        **{f"speaking_share_{rule}": means["hug", rule] for rule in (FIXED, REST, CHANGE)},
        **{
            f"{name}_share_{rule}": means[name, rule]
            for name in ("walk", "day")
            for rule in (FIXED, REST, CHANGE)
        },
    )


def torso() -> SkinConfig:
    """Return the skin that is hugged, or walked on."""
    return SkinConfig.of(read_file(ROOT / "config" / "sparse_skin.yaml") | {"pitch_mm": 10.0})


def speaking(spec: FrameSpec, frames: Iterator[Codes]) -> dict[str, Floats]:
    """Return by rule which share of the nodes has news in each of these frames of codes."""
    heartbeat = usual_heartbeat(min(spec.frame_period_s, 0.02))
    follows = {FIXED: NEVER, **{rule: usual_follow(spec, rule) for rule in (REST, CHANGE)}}
    rules = {name: NodeRules(THRESHOLD, heartbeat, follow) for name, follow in follows.items()}
    first = next(frames)
    beat = np.arange(first.size) * heartbeat // first.size
    rests = dict.fromkeys(rules, first)
    sent = {name: first.copy() for name in rules}
    shares: dict[str, list[float]] = {name: [] for name in rules}
    for number, codes in enumerate(frames):
        for name, rule in rules.items():
            news = rule.has_news(codes, rests[name], sent[name])
            shares[name].append(news.mean())
            sent[name] = np.where(news | (beat == number % heartbeat), codes, sent[name])
            rests[name] = rule.followed(number, codes, rests[name])
    return {name: np.array(some) for name, some in shares.items()}


def touched(config: SkinConfig, scene: Scene) -> Iterator[Codes]:
    """Yield what the nodes of a touched skin measure, frame by frame."""
    options = SimOptions.from_url(f"sim://?sensor=paper&sensor_noise={NOISE_V}", config.layout)
    sent = truth(options, Setup(config.spec, samples_per_chip=1, integrated=True), scene=scene)
    for frame in islice(sent, round(SECONDS / config.spec.frame_period_s)):
        yield frame.codes


def hug(t_s: float, skin: SkinGeometry) -> Floats:
    """Hold a torso: two arms across it and a chest, which breathe, and slide a little."""
    since_s = t_s % HUG_S - 1.0
    grip = min(max(min(since_s, HOLD_S - since_s) / GRIP_S, 0.0), 1.0)
    breath = math.sin(2 * math.pi * 0.25 * t_s)
    load_pa = HUG_PA * grip * (1 + 0.15 * breath + 0.02 * math.sin(2 * math.pi * 8 * t_s))
    width_m, height_m = 2 * skin.half_extent_m
    across, along = skin.positions_m.T - np.array([[0.0], [0.004 * breath]])
    arms = [np.abs(along - place * height_m) / 0.05 for place in (-0.2, 0.15)]
    chest = np.hypot(across, along) / (0.3 * width_m)
    rho = np.minimum.reduce([*arms, chest])
    return np.asarray(load_pa * np.clip(1 - rho**2, 0, None) ** 1.5)


def walk(t_s: float, skin: SkinGeometry) -> Floats:
    """Walk to and fro, foot by foot: each rolls from its heel to its ball."""
    width_m, height_m = 2 * skin.half_extent_m
    pressure_pa = np.zeros(len(skin.positions_m))
    for step in (math.floor(t_s / STEP_S), math.floor(t_s / STEP_S) - 1):
        share = (t_s - step * STEP_S) / CONTACT_S
        if not 0 <= share < 1:
            continue
        heel_m = np.array([0.25 * width_m * (-1) ** step, (step % 2 - 0.75) * 0.5 * height_m])
        for at_m, load in ((0.0, 1 - share), (0.18, share)):
            far_m = skin.positions_m - heel_m - [0.0, at_m]
            rho = np.hypot(far_m[:, 0] / 0.04, far_m[:, 1] / 0.06)
            lifted = math.sin(math.pi * share) ** 0.5
            pressure_pa += FOOT_PA * load * lifted * np.clip(1 - rho**2, 0, None) ** 1.5
    return pressure_pa


def day() -> Iterator[Codes]:
    """Yield codes of untouched nodes, each of which drifts as far as the temperature has it."""
    adc, rng = AdcScale(10), np.random.default_rng(1)
    rest_v = rng.uniform(0.9, 0.95, DRIFTING) * adc.vref_v
    swing_v = rng.uniform(-DRIFT, DRIFT, DRIFTING) * adc.vref_v
    for t_s in np.arange(0, DAY_S, FRAME_S):
        warm = (1 - math.cos(2 * math.pi * t_s / DAY_S)) / 2
        yield adc.code(rest_v + warm * swing_v + NOISE_V * rng.standard_normal(DRIFTING))


def figure(found: dict[tuple[str, str], Floats]) -> Figure:
    """Draw the shares over time, a panel for each scene."""
    picture = sheet(400)
    names = list(dict.fromkeys(name for name, _ in found))
    for axes, name in zip(picture.subplots(1, len(names)), names, strict=True):
        for (scene, rule), shares in found.items():
            if scene == name:
                span = DAY_S / 3600 if name == "day" else SECONDS
                axes.plot(np.linspace(0, span, shares.size), 100 * shares, label=rule, lw=0.8)
        axes.set(title=name, xlabel="h" if name == "day" else "s", ylim=(0, None))
        axes.set_xlim(0, 5 if name == "walk" else None)
    picture.axes[0].set_ylabel("nodes that speak, %")
    for line in axes.legend().get_lines():
        line.set_linewidth(3)
    return picture


if __name__ == "__main__":
    main()
