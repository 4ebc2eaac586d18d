# SPDX-License-Identifier: Apache-2.0

"""Contacts of MuJoCo on the simulated skin: what lies on a skin weighs what it weighs."""

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo (pip install mujoco) is not installed")

import mujoco

from tactile_cdma import ParameterError, Skin
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import cylinder
from tactile_cdma.places.poses import Pose
from tactile_cdma.sim import Foundation

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "mujoco_skin.py"
MujocoSkin = runpy.run_path(str(EXAMPLE))["MujocoSkin"]
LAYOUT = Layout.grid(16, 4, 4, 7e-3, 7e-3)
COVER = Foundation(LAYOUT.positions_m, LAYOUT.normals, LAYOUT.areas_m2)
TURNED = Pose.of_rpy((0.0, 0.0, 0.01), (0.0, 0.0, np.pi / 2))  # the skin's x along the world's y
KG, G = 0.1, 9.81


CUBE = " ".join(f"{x} {y} {z}" for x in (-6, 6) for y in (-6, 6) for z in (-6, 6))


def lying(
    geom: str, place: str = "0.003 -0.002", on: Any = "pad", pose: Pose = TURNED
) -> tuple[MujocoSkin, Any]:
    """A thing at rest on a pad that is covered with a skin, 20 mm above the floor."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.001"/>
        <asset><mesh name="cube" vertex="{CUBE}" scale="0.001 0.001 0.001"/></asset><worldbody>
        <body name="table" pos="0.1 0.2 0.02">
          <site name="top" pos="0 0 0.01" euler="0 0 90"/>
          <geom name="pad" type="box" size="0.015 0.03 0.01" pos="-0.015 0 0"/>
          <geom name="half" type="box" size="0.015 0.03 0.01" pos="0.015 0 0"/>
        </body>
        <body pos="0.1 0.2 0"><body pos="{place} 0.05">
          <joint type="slide" axis="0 0 1" damping="1"/><geom name="thing" {geom} mass="{KG}"/>
        </body></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    return MujocoSkin(model, on, LAYOUT, pose), data


@pytest.mark.parametrize(
    "geom",
    [
        "type='sphere' size='0.01'",
        "type='cylinder' size='0.006 0.003'",
        "type='capsule' size='0.008 0.006' euler='90 0 0'",
        "type='box' size='0.006 0.006 0.006'",
        "type='ellipsoid' size='0.008 0.006 0.004'",
        "type='mesh' mesh='cube'",
    ],
)
def test_the_skin_carries_the_weight_where_the_thing_lies(geom: str) -> None:
    skin, data = lying(geom, on="table")
    [thing] = skin.objects(data)
    load_n = COVER.pressure_pa([thing]) * LAYOUT.areas_m2
    assert load_n.sum() == pytest.approx(KG * G, rel=0.01)
    assert skin.pressure_pa(data) * LAYOUT.areas_m2 == pytest.approx(load_n, rel=1e-6, abs=1e-9)
    centre_m = load_n @ LAYOUT.positions_m / load_n.sum()
    # Where it lies in the world, (3, −2) mm from the pad's middle, is (−2, −3) in the skin's frame.
    assert centre_m == pytest.approx([-2e-3, -3e-3, 0], abs=0.5e-3)
    with Skin("sim://?scene=external&speed=0&threshold=0", nodes=16) as felt:
        pressure_pa = felt.step(*skin.objects(data)).pressure_pa
    assert float(pressure_pa @ LAYOUT.areas_m2) == pytest.approx(KG * G, rel=0.03)


BESIDE = Pose(TURNED.rotation, np.array([0.015, 0.0, 0.01]))  # of the pad's half


@pytest.mark.parametrize(
    ("on", "pose"),
    [
        ("table", TURNED),
        (["pad", "half"], TURNED),
        ([0, 1], TURNED),
        ("top", Pose(np.eye(3), np.zeros(3))),
    ],
)
def test_a_skin_may_cover_a_body_or_several_geoms_or_be_at_a_site(on: Any, pose: Pose) -> None:
    """The thing lies on both halves of the pad; a geom alone has half of the force."""
    box = "type='box' size='0.006 0.006 0.006'"
    skin, data = lying(box, place="0 0", on=on, pose=pose)
    assert sum(skin.forces_n(data).values()) == pytest.approx(KG * G, rel=0.01)
    [thing] = skin.objects(data)
    load_n = COVER.pressure_pa([thing]) * LAYOUT.areas_m2
    assert load_n @ LAYOUT.positions_m / load_n.sum() == pytest.approx([0, 0, 0], abs=0.5e-3)
    for part in ("pad", 0):
        half, data = lying(box, place="0 0", on=part, pose=BESIDE)
        assert sum(half.forces_n(data).values()) == pytest.approx(KG * G / 2, rel=0.1)


def test_a_finger_is_pressed_along_the_force_not_along_its_skins_z() -> None:
    """A curved skin on a capsule; a ball weighs on its flank, 40° from the skin's z."""
    surface = cylinder(8, 7, 3e-3, 8e-3)
    wiring = {"name": "tip", "rows": 8, "columns": 7, "pitch_m": 3e-3}
    layout = Layout(**vars(surface), nodes=np.arange(1, 57, dtype=np.int32), **wiring)
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.001"/><worldbody>
        <geom name="tip" type="capsule" size="0.008 0.02" euler="90 0 0"/>
        <body pos="0 0 0.0181"><joint type="slide" axis="0 0 1" damping="1"/>
          <geom type="sphere" size="0.01" mass="{KG}"/></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    tilt = math.radians(40)
    # The geom's z is the world's −y: the skin's y along it, its z 40° from the world's z.
    out = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    in_world = np.column_stack([np.cross([0, -1, 0], out), [0, -1, 0], out])
    geom = np.array(data.geom("tip").xmat).reshape(3, 3)
    skin = MujocoSkin(model, "tip", layout, Pose(geom.T @ in_world, geom.T @ out * 8e-3))
    [ball] = skin.objects(data)
    cover = Foundation(layout.positions_m, layout.normals, layout.areas_m2)
    load_n = (cover.pressure_pa([ball]) * layout.areas_m2) @ layout.normals
    assert skin.frame(data).rotate(load_n) == pytest.approx([0, 0, KG * G], abs=0.02 * KG * G)


def test_nothing_touches_in_the_air_or_beside_the_skin() -> None:
    skin, data = lying("type='sphere' size='0.01'", place="0.2 0")
    assert skin.objects(data) == [], "there is no floor: it falls past the pad"
    skin, data = lying("type='sphere' size='0.005'", place="0.025 0", on="table")
    [thing] = skin.objects(data)
    assert not COVER.pressure_pa([thing]).any(), "it lies on the pad's rim"


def test_what_is_not_there_or_not_one_body_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
        <body name="arm"><geom name="link" size="0.1"/><body name="bare"><joint/>
        <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""
    )
    for on, words in (
        ("finger", "no geom, body or site 'finger'"),
        (7, "no geom 7"),
        (["floor", "link"], "are of 2 bodies"),
        ("bare", "a body without geoms"),
    ):
        with pytest.raises(ParameterError, match=words):
            MujocoSkin(model, on, LAYOUT, TURNED)


def test_what_a_flex_presses_is_not_taken_for_another_geom() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option timestep="0.001"/><worldbody>
        <geom name="pad" type="box" size="0.03 0.03 0.01"/>
        <flexcomp type="grid" count="4 4 4" spacing="0.005 0.005 0.005" pos="0 0 0.02" name="soft"
          dim="3" mass="0.1" radius="0.001"><edge equality="true" damping="1"/></flexcomp>
        <geom name="last" type="sphere" size="0.01" pos="0 0 0.05"/></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    assert data.ncon
    for number in np.int32(0), 0:
        skin = MujocoSkin(model, number, LAYOUT)
        with pytest.raises(ParameterError, match="a flex touches the skin"):
            skin.pressure_pa(data)
