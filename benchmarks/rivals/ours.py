# SPDX-License-Identifier: Apache-2.0

"""BatchCover and SkinBatch on the scene: the ball's weight, as physics elsewhere would give it."""

import numpy as np

import tactile_cdma
from tactile_cdma import Skin
from tactile_cdma.sim import BatchCover, SkinBatch, Sphere

from .scene import (
    ENVS,
    MASS_KG,
    PITCH_M,
    PLACE_M,
    RADIUS_M,
    SIDE,
    STIFFNESS_PA_PER_M,
    cost_us,
    tell,
)

EARTH_N_PER_KG = 9.81


def main() -> None:
    edge_mm = PITCH_M * 1e3
    port = "sim://?mismatch=0.03"
    skin = Skin(port, nodes=SIDE**2, rows=SIDE, columns=SIDE, pitch_mm=edge_mm, taxel_mm=edge_mm)
    cover, batch = BatchCover(skin.layout), SkinBatch(skin.config, ENVS, port, 0, tared=True)
    ball = Sphere(radius_m=RADIUS_M, position_m=(0, 0, 0), stiffness_pa_per_m=STIFFNESS_PA_PER_M)
    place_m = np.tile(np.array([*PLACE_M, 0.0], np.float32), (ENVS, 1))
    force_n = np.full(ENVS, MASS_KG * EARTH_N_PER_KG, np.float32)
    state = batch.begin(place_m)

    def frame() -> tactile_cdma.sim.batch.BatchFrame:
        return batch.step(state, cover.pressure_pa(ball, place_m, None, force_n))[1]

    pressure_pa = frame().pressure_pa[0].astype(np.float64)
    forces_n = np.nan_to_num(pressure_pa) * cover.areas_m2
    tell(tactile_cdma.__version__, ENVS, 0.0, cost_us(frame, ENVS), forces_n.tolist())


if __name__ == "__main__":
    main()
