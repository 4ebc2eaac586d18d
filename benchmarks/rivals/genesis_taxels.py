# SPDX-License-Identifier: Apache-2.0

"""Genesis' KinematicTaxel on the scene: how far objects are within a radius of each taxel."""

import math
from typing import Any

import genesis as gs
import numpy as np

from .scene import (
    ENVS,
    MASS_KG,
    PITCH_M,
    PLACE_M,
    PLATE_M,
    RADIUS_M,
    SETTLED_STEPS,
    SIDE,
    STEP_S,
    STIFFNESS_PA_PER_M,
    THICK_M,
    cost_us,
    tell,
)

REACH_M = 0.0035
"""Radius about a taxel in which it feels: half of the pitch."""


def settled(feels: bool) -> tuple[Any, Any]:
    """Let the ball lie on the plate; returns the scene, and the sensor if the plate has one."""
    scene = gs.Scene(sim_options=gs.options.SimOptions(dt=STEP_S), show_viewer=False)
    plate = scene.add_entity(
        gs.morphs.Box(size=(PLATE_M, PLATE_M, THICK_M), pos=(0, 0, -THICK_M / 2), fixed=True)
    )
    rho = MASS_KG / (4 / 3 * math.pi * RADIUS_M**3)
    ball = gs.morphs.Sphere(radius=RADIUS_M, pos=(*PLACE_M, RADIUS_M))
    scene.add_entity(ball, material=gs.materials.Rigid(rho=rho))
    along_m = (np.arange(SIDE) - (SIDE - 1) / 2) * PITCH_M
    places_m = np.stack(np.meshgrid(along_m, along_m, [THICK_M / 2], indexing="ij"), axis=-1)
    taxels = gs.sensors.KinematicTaxel(
        entity_idx=plate.idx,
        probe_local_pos=places_m.reshape(SIDE, SIDE, 3),
        probe_radius=REACH_M,
        normal_stiffness=STIFFNESS_PA_PER_M * PITCH_M**2,
    )
    sensor = scene.add_sensor(taxels) if feels else None
    scene.build(n_envs=ENVS)
    for _ in range(SETTLED_STEPS):
        scene.step()
    return scene, sensor


def main() -> None:
    gs.init(backend=gs.cpu, logging_level="error")
    step_us = cost_us(settled(False)[0].step, ENVS)
    scene, sensor = settled(True)

    def frame() -> object:
        scene.step()
        return sensor.read()

    frame_us = cost_us(frame, ENVS)
    force_n = np.asarray(sensor.read().force[0].cpu()).reshape(-1, 3)
    tell(gs.__version__, ENVS, step_us, frame_us, np.linalg.norm(force_n, axis=1).tolist())


if __name__ == "__main__":
    main()
