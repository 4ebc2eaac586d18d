# SPDX-License-Identifier: Apache-2.0

"""Contacts of MuJoCo on the simulated skin: what lies on a skin weighs what it weighs."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo (pip install mujoco) is not installed")

import mujoco

from tactile_cdma import ParameterError, Skin
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.poses import Pose
from tactile_cdma.sim import Foundation

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "mujoco_skin.py"
MujocoSkin = runpy.run_path(str(EXAMPLE))["MujocoSkin"]
LAYOUT = Layout.grid(16, 4, 4, 7e-3, 7e-3)
COVER = Foundation(LAYOUT.positions_m, LAYOUT.normals, LAYOUT.areas_m2)
TURNED = Pose.of_rpy((0.0, 0.0, 0.01), (0.0, 0.0, np.pi / 2))  # the skin's x along the world's y
KG, G = 0.1, 9.81


def lying(geom: str, place: str = "0.003 -0.002") -> tuple[MujocoSkin, Any]:
    """A thing at rest on a pad that is covered with a skin, 20 mm above the floor."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.001"/><worldbody>
        <geom name="pad" type="box" pos="0.1 0.2 0.02" size="0.03 0.03 0.01"/>
        <body pos="0.1 0.2 0"><body pos="{place} 0.05">
          <joint type="slide" axis="0 0 1" damping="1"/><geom name="thing" {geom} mass="{KG}"/>
        </body></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    return MujocoSkin(model, "pad", LAYOUT, TURNED), data


@pytest.mark.parametrize(
    "geom",
    [
        "type='sphere' size='0.01'",
        "type='cylinder' size='0.006 0.003'",
        "type='capsule' size='0.008 0.006' euler='90 0 0'",
        "type='box' size='0.006 0.006 0.006'",
    ],
)
def test_the_skin_carries_the_weight_where_the_thing_lies(geom: str) -> None:
    skin, data = lying(geom)
    [thing] = skin.objects(data)
    load_n = COVER.pressure_pa([thing]) * LAYOUT.areas_m2
    assert load_n.sum() == pytest.approx(KG * G, rel=0.01)
    centre_m = load_n @ LAYOUT.positions_m / load_n.sum()
    # Where it lies in the world, (3, −2) mm from the pad's middle, is (−2, −3) in the skin's frame.
    assert centre_m == pytest.approx([-2e-3, -3e-3, 0], abs=0.5e-3)
    with Skin("sim://?scene=external&speed=0&threshold=0", nodes=16) as felt:
        pressure_pa = felt.step(*skin.objects(data)).pressure_pa
    assert float(pressure_pa @ LAYOUT.areas_m2) == pytest.approx(KG * G, rel=0.03)


def test_nothing_touches_in_the_air_or_beside_the_skin() -> None:
    skin, data = lying("type='sphere' size='0.01'", place="0.2 0")
    assert skin.objects(data) == [], "there is no floor: it falls past the pad"
    skin, data = lying("type='sphere' size='0.005'", place="0.025 0")
    [thing] = skin.objects(data)
    assert not COVER.pressure_pa([thing]).any(), "it lies on the pad's rim"


def test_shapes_that_the_skin_does_not_know_are_named() -> None:
    skin, data = lying("type='ellipsoid' size='0.01 0.01 0.01'")
    with pytest.raises(ParameterError, match="geom thing is a mjGEOM_ELLIPSOID"):
        skin.objects(data)


def test_a_geom_that_is_not_there_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(ParameterError, match="no geom 'finger'"):
        MujocoSkin(model, "finger", LAYOUT, TURNED)
