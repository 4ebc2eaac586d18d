# SPDX-License-Identifier: Apache-2.0

"""Presses a ball into a simulated skin, frame by frame; no ROS is needed.

Shows the simulator that one can press: objects with poses in the frame of the skin go in, and what
comes out has passed through sensors, ADC, line and decoder. Time passes by step() only, so the
result is the same on every computer. docs/simulation.md has the model.

Start it:  .venv/bin/python examples/press_a_skin.py
It prints depth (mm), force by the closed form and by the skin (N), and the centre felt (mm).
"""

import math

import numpy as np

from tactile_cdma import Skin
from tactile_cdma.sim import Sphere

RADIUS_M, STIFFNESS_PA_PER_M = 0.02, 1e7

with Skin("sim://?scene=external&speed=0", nodes=64, frame_period_ms=40.0) as skin:
    while np.isnan(skin.step().pressure_pa).any():
        pass  # until every node has spoken once, which they do within a second of skin time
    areas_m2 = skin.layout.areas_m2
    for depth_m in np.linspace(0.6e-3, 3e-3, 13):
        x_m = 2 * depth_m
        ball = Sphere(
            radius_m=RADIUS_M,
            position_m=(x_m, 0.0, RADIUS_M - depth_m),
            stiffness_pa_per_m=STIFFNESS_PA_PER_M,
        )
        load_n = skin.step(ball).pressure_pa * areas_m2
        volume_m3 = math.pi * depth_m**2 * (3 * RADIUS_M - depth_m) / 3
        centre_mm = 1e3 * load_n @ skin.layout.positions_m / load_n.sum()
        print(
            f"{1e3 * depth_m:.2f} mm: {STIFFNESS_PA_PER_M * volume_m3:.3f} N pressed, "
            f"{load_n.sum():.3f} N felt at {centre_mm[0]:.2f} mm, it is at {1e3 * x_m:.2f} mm"
        )
