# SPDX-License-Identifier: Apache-2.0

"""Tunes a grip in thousands of worlds at once, then grips with it in MuJoCo by the real driver.

    .venv/bin/python examples/batched_grip.py        # pip install array-api-compat mujoco

A finger with a skin of 4 × 6 taxels closes on a cylinder until it presses with FORCE_N. Where the
cylinder is, how thick and how stiff, nobody tells. Three numbers decide how: the speed before
contact, the gain, and the damping. The cross-entropy method tunes them on SkinBatch, whose frames
are late, quantised, noisy and held as those of a driver; worlds of its own are drawn in every
generation. The result then closes a gripper in MuJoCo, whose skin goes through the simulated line,
digitizer and decoder. The last line compares both.
"""

import argparse
import time
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np
from mujoco_skin import MujocoSkin
from numpy.typing import NDArray

from tactile_cdma import Skin
from tactile_cdma.places.poses import Pose
from tactile_cdma.sim import BatchCover, Cylinder, SkinBatch

Floats: TypeAlias = NDArray[np.float32]
SKIN: dict[str, Any] = {"nodes": 24, "rows": 4, "columns": 6, "pitch_mm": 5.0, "taxel_mm": 5.0}
FRAME_S, SECONDS, FORCE_N, TOUCH_N = 16e-3, 1.2, 2.0, 0.1
PORT = "sim://?scene=external&speed=0&nodes=24&rows=4&columns=6&pitch_mm=5&sensor_noise=0.004"
FASTEST_M_S = 0.1
GUESS = np.array([0.02, 0.01, 1e-4])
"""Speed before contact, m/s; speed per N of error; the same per N/s of its change."""
GRIPS = (2e-3, 8000.0, 0.02), (5e-3, 1500.0, 0.015), (7e-3, 5000.0, 0.025)
"""In MuJoCo: gap, m, stiffness, N/m, and radius, m."""
SPREAD = 0.7
"""Spread of the logarithms of the three, at first."""


@dataclass(frozen=True)
class Worlds:
    """Cylinders: (e,) gaps before contact, (e,) stiffness of grip and object, (e, 3) places.

    radius_m: the same for all of a generation.
    """

    gap_m: Floats
    stiffness_n_per_m: Floats
    place_m: Floats
    radius_m: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, count: int, repeats: int = 1) -> "Worlds":
        """So many, each set of them `repeats` times."""
        gap_m, stiffness = rng.uniform(1e-3, 8e-3, count), np.exp(rng.uniform(7, 9, count))
        place_m = rng.uniform(-5e-3, 5e-3, (count, 3))
        gaps_m, stiffnesses, places_m = (
            np.concatenate([array] * repeats).astype(np.float32)
            for array in (gap_m, stiffness, place_m)
        )
        return cls(gaps_m, stiffnesses, places_m, float(rng.uniform(0.01, 0.03)))


def speed_m_s(rules: Any, felt_n: Any, before_n: Any) -> Any:
    """How fast to close, by the forces felt in this frame and the one before; rules: (3, …)."""
    approach, gain, damping = rules
    answer = gain * (FORCE_N - felt_n) - damping * (felt_n - before_n) / FRAME_S
    return np.clip(np.where(felt_n < TOUCH_N, approach, answer), -FASTEST_M_S, FASTEST_M_S)


def gripped(rules: Any, worlds: Worlds, rng: np.random.Generator) -> Floats:
    """Force on the skin at every frame, (frames, e), N; rules: (3, e)."""
    skin = Skin(PORT, **SKIN, frame_period_ms=1e3 * FRAME_S)
    count = len(worlds.gap_m)
    batch, cover = SkinBatch(skin.config, count, skin.port), BatchCover(skin.layout)
    state, areas_m2 = batch.begin(np.zeros((), np.float32)), cover.areas_m2.astype(np.float32)
    thing = Cylinder(radius_m=worlds.radius_m, length_m=0.03, position_m=(0, 0, 0))
    turned = np.broadcast_to(np.array([1, 0, 0, 1], np.float32), (count, 4))  # its axis along y
    closed_m, before_n, forces_n = np.zeros(count, np.float32), np.zeros(count, np.float32), []
    for _ in range(round(SECONDS / FRAME_S)):
        force_n = worlds.stiffness_n_per_m * np.maximum(closed_m - worlds.gap_m, 0)
        pressure_pa = cover.pressure_pa(thing, worlds.place_m, turned, force_n)
        noise = rng.standard_normal(pressure_pa.shape, np.float32)
        state, frame = batch.step(state, pressure_pa, noise)
        felt_n = np.nan_to_num(frame.pressure_pa) @ areas_m2
        speed = speed_m_s(rules, felt_n, before_n)
        closed_m, before_n = (closed_m + FRAME_S * speed).astype(np.float32), felt_n
        forces_n.append(force_n)
    return np.array(forces_n)


def cost(forces_n: Floats) -> Floats:
    """(e,): mean error, and what is more than 10 % too much, as shares of the force wanted."""
    error = np.abs(forces_n - FORCE_N).mean(axis=0) / FORCE_N
    return np.asarray(error + np.maximum(forces_n.max(axis=0) / FORCE_N - 1.1, 0))


def tuned(generations: int, candidates: int, worlds: int, seed: int = 0) -> NDArray[np.float64]:
    """The three numbers, by the cross-entropy method, and the course of it on the terminal."""
    rng = np.random.default_rng(seed)
    mean, spread = np.log(GUESS), np.full(3, SPREAD)
    for generation in range(generations):
        drawn = np.exp(mean + spread * rng.standard_normal((candidates, 3)))
        drawn[0] = np.exp(mean)
        rules = drawn.astype(np.float32).repeat(worlds, axis=0).T
        forces_n = gripped(rules, Worlds.drawn(rng, worlds, candidates), rng)
        costs = cost(forces_n).reshape(candidates, worlds).mean(axis=1)
        best = np.log(drawn[np.argsort(costs)[: max(2, candidates // 5)]])
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.02
        print(f"generation {generation}: cost {costs.min():.3f}, of the mean {costs[0]:.3f}")
    return np.asarray(np.exp(mean))


MODEL = """
<mujoco>
  <option timestep="0.0005" cone="elliptic" impratio="50"/>
  <worldbody>
    <body gravcomp="1" pos="-{place} 0 0">
      <joint name="left" type="slide" axis="1 0 0" damping="40"/>
      <geom name="skin" type="box" size="0.004 0.015 0.012" mass="0.1" friction="0.8"/>
    </body>
    <body gravcomp="1" pos="{place} 0 0">
      <joint name="right" type="slide" axis="-1 0 0" damping="40"/>
      <geom type="box" size="0.004 0.015 0.012" mass="0.1" friction="0.8"/>
    </body>
    <body gravcomp="1">
      <freejoint/>
      <geom type="cylinder" size="{radius} 0.015" euler="90 0 0" mass="0.1" friction="0.8"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="left" kp="{stiffness}"/>
    <position joint="right" kp="{stiffness}"/>
  </actuator>
</mujoco>
"""


def in_mujoco(rules: Any, gap_m: float, stiffness_n_per_m: float, radius_m: float) -> Floats:
    """Force on the skin at every frame, (frames, 1), N, with line, digitizer and driver."""
    mujoco = import_module("mujoco")
    text = MODEL.format(
        place=radius_m + gap_m + 0.004, radius=radius_m, stiffness=stiffness_n_per_m
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    steps = round(FRAME_S / model.opt.timestep)
    closed_m, before_n, forces_n = 0.0, 0.0, []
    with Skin(PORT, **SKIN, frame_period_ms=1e3 * FRAME_S) as skin:
        # The skin's x is the finger's y, its z points out of the finger.
        pose = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.004, 0, 0]))
        finger, areas_m2 = MujocoSkin(model, "skin", skin.layout, pose), skin.layout.areas_m2
        for _ in range(skin.config.spec.nodes * 3):  # until every node has spoken
            frame = skin.step()
        for _ in range(round(SECONDS / FRAME_S)):
            data.ctrl[:] = closed_m
            mujoco.mj_step(model, data, steps)
            forces_n.append([sum(finger.forces_n(data).values())])
            felt_n = float(np.nan_to_num(frame.pressure_pa) @ areas_m2)  # of the step before
            frame = skin.step(*finger.objects(data))
            closed_m += FRAME_S * float(speed_m_s(rules, felt_n, before_n))
            before_n = felt_n
    return np.array(forces_n, np.float32)


def figures(name: str, forces_n: Floats) -> str:
    """Means of cost and overshoot, %, and the median time until the force stays within 10 %, ms."""
    over = np.maximum(forces_n.max(axis=0) / FORCE_N - 1, 0)
    off = np.abs(forces_n / FORCE_N - 1) > 0.1
    settled_s = FRAME_S * (len(off) - off[::-1].argmax(axis=0)) * off.any(axis=0)
    return (
        f"{name}_cost={cost(forces_n).mean():.2f} {name}_overshoot_percent={100 * over.mean():.0f} "
        f"{name}_settled_ms={1e3 * np.median(settled_s):.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Tunes a grip in thousands of worlds at once.")
    parser.add_argument("--generations", type=int, default=6)
    parser.add_argument("--candidates", type=int, default=20)
    parser.add_argument("--worlds", type=int, default=32, help="of each candidate")
    arguments = parser.parse_args()
    begun_s = time.monotonic()
    rules = tuned(arguments.generations, arguments.candidates, arguments.worlds)
    approach, gain, damping = rules
    print(f"tuned in {time.monotonic() - begun_s:.0f} s: approach {1e3 * approach:.0f} mm/s, ")
    print(f"  gain {1e3 * gain:.2f} mm/s per N, damping {1e3 * damping:.3f} mm/s per N/s")
    rng = np.random.default_rng(99)
    said = []
    for name, used in (("guess", GUESS), ("batch", rules)):
        columns = used.astype(np.float32)[:, None]
        said.append(figures(name, gripped(columns, Worlds.drawn(rng, 200), rng)))
    for name, used in (("guess_in_mujoco", GUESS), ("mujoco", rules)):
        courses = [in_mujoco(used, *grip) for grip in GRIPS]
        said.append(figures(name, np.concatenate(courses, axis=1)))
    print(" ".join(said))


if __name__ == "__main__":
    main()
