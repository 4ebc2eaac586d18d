#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Draws docs/img/grip.png: examples/mujoco_grip.py with its cue for slip, and without.

.venv/bin/python tools/grip_picture.py    # after make example-grip; renders with EGL
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")
ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples"))

import matplotlib.pyplot as plt  # noqa: E402
import mujoco  # noqa: E402
import mujoco_grip  # noqa: E402
import numpy as np  # noqa: E402
import rclpy  # noqa: E402

MOMENTS = 5
PICTURE = ROOT / "docs" / "img" / "grip.png"
COLOURS = {"with the cue": "#1f6f8b", "without it": "#c8553d"}


def main():
    rclpy.init()
    node = rclpy.create_node("mujoco_grip")
    runs = {
        name: mujoco_grip.run(node, slip_m_s)
        for name, slip_m_s in zip(COLOURS, (5e-3, 1e9), strict=True)
    }
    rclpy.shutdown()
    figure = plt.figure(figsize=(9, 8.2), layout="constrained")
    rows = figure.subfigures(3, 1, height_ratios=(1, 1, 1.9))
    for row, (name, (outcome, course, states)) in zip(rows, runs.items(), strict=False):
        print(f"{name}: {outcome}")
        strip(row, name, course[:, 0], states)
    curves(rows[2], runs)
    figure.savefig(PICTURE, dpi=80)
    print(PICTURE.relative_to(ROOT))


def strip(figure, name, times_s, states):
    """Draw a run in pictures, from before it grips to its end."""
    cell = mujoco_grip.Cell()
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = (0, 0, 0.05), 0.24, 100, -8
    figure.suptitle(name, x=0.01, ha="left", fontsize=10)
    with mujoco.Renderer(cell.model, 240, 240) as renderer:
        moments = [0, *np.searchsorted(times_s, np.linspace(2.5, times_s[-1] - 0.15, MOMENTS - 1))]
        for axes, moment in zip(figure.subplots(1, MOMENTS), moments, strict=True):
            cell.data.qpos[:] = states[moment]
            mujoco.mj_forward(cell.model, cell.data)
            renderer.update_scene(cell.data, camera)
            axes.imshow(renderer.render())
            axes.set_title(f"{times_s[moment]:.1f} s", fontsize=9)
            axes.axis("off")


def curves(figure, runs):
    """Draw what the skin felt, and what came of it."""
    panels = figure.subplots(2, 2, sharex=True)
    for name, (_, course, _) in runs.items():
        times_s, felt_pa, closed_mm, _, up_m, slid_m, mass_kg, _ = course.T
        for axes, values, text in zip(
            panels.flat,
            (1e-3 * felt_pa, closed_mm, 1e3 * up_m, 1e3 * slid_m),
            ("pressure felt, kPa", "closed, mm", "height, mm", "slid in the fingers, mm"),
            strict=True,
        ):
            axes.plot(times_s, values, color=COLOURS[name], label=name)
            axes.set_title(text, fontsize=9, loc="left")
            axes.grid(alpha=0.3)
        filled = times_s[mass_kg > mujoco_grip.LIGHT_KG]
    for axes in panels.flat:
        axes.axvline(filled[0], color="grey", lw=0.8, ls=":")
    panels[0, 0].legend(fontsize=8)
    panels[1, 1].set_ylim(-2, 22)
    for axes in panels[1]:
        axes.set_xlabel("s; dotted: filling begins", fontsize=9)


if __name__ == "__main__":
    main()
