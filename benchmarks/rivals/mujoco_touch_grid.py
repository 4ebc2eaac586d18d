# SPDX-License-Identifier: Apache-2.0

"""MuJoCo's touch_grid on the scene: it sorts contact points into a grid of directions."""

import math

import mujoco

from .scene import (
    MASS_KG,
    PLACE_M,
    PLATE_M,
    RADIUS_M,
    SETTLED_STEPS,
    SIDE,
    STEP_S,
    THICK_M,
    cost_us,
    tell,
)

BELOW_M = 2 * THICK_M
"""Depth of the eye that the grid's directions begin at."""
VIEW_DEG = 2 * math.degrees(math.atan(PLATE_M / 2 / BELOW_M))
SENSOR = f"""
  <sensor>
    <plugin plugin="mujoco.sensor.touch_grid" objtype="site" objname="eye">
      <config key="size" value="{SIDE} {SIDE}"/><config key="nchannel" value="1"/>
      <config key="fov" value="{VIEW_DEG / 2} {VIEW_DEG / 2}"/><config key="gamma" value="0"/>
    </plugin>
  </sensor>"""
WORLD = f"""<mujoco>
  <extension><plugin plugin="mujoco.sensor.touch_grid"/></extension>
  <option timestep="{STEP_S}"/>
  <worldbody>
    <geom type="box" size="{PLATE_M / 2} {PLATE_M / 2} {THICK_M / 2}" pos="0 0 {-THICK_M / 2}"/>
    <site name="eye" pos="0 0 {-BELOW_M}" euler="180 0 0"/>
    <body pos="{PLACE_M[0]} {PLACE_M[1]} {RADIUS_M}">
      <freejoint/><geom type="sphere" size="{RADIUS_M}" mass="{MASS_KG}"/>
    </body>
  </worldbody>{{sensor}}
</mujoco>"""


def settled(sensor: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Let the ball lie on the plate."""
    model = mujoco.MjModel.from_xml_string(WORLD.format(sensor=sensor))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, SETTLED_STEPS)
    return model, data


def main() -> None:
    plain, felt = settled(""), settled(SENSOR)
    step_us = cost_us(lambda: mujoco.mj_step(*plain), 1)
    frame_us = cost_us(lambda: mujoco.mj_step(*felt), 1)
    tell(mujoco.__version__, 1, step_us, frame_us, felt[1].sensordata.tolist())


if __name__ == "__main__":
    main()
