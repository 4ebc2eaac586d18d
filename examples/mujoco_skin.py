# SPDX-License-Identifier: Apache-2.0

"""Contacts of a MuJoCo geom as objects on the simulated skin, to copy: pip install mujoco.

MuJoCo's bodies are nearly rigid: its contacts have forces, but no depth that a soft cover would
have. So each object that touches the geom is pressed into the cover until that answers with
MuJoCo's normal force, and the skin reads what the physics carries. examples/mujoco_grip.py uses
examples/mujoco_skin.py.
"""

from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np

from tactile_cdma import ParameterError
from tactile_cdma.base.arrays import Floats
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.poses import Pose
from tactile_cdma.sim import Box, Cylinder, Foundation, Indenter, Sphere
from tactile_cdma.sim.indenters import STIFFNESS_PA_PER_M

ABOVE_M, FIRST_M, GROWTH, DEEPEST_M = 2e-3, 1e-4, 1.5, 0.02
"""The depth that gives a force is searched from ABOVE_M above MuJoCo's place down to DEEPEST_M, m,
in steps that begin with FIRST_M and grow by GROWTH. Chosen: MuJoCo's contacts are flatter than
ABOVE_M, and the soft cover of a finger is thinner than DEEPEST_M."""
HALVINGS = 20
"""Halvings of the step in which the force is reached: the depth is then known to a few nm."""


class MujocoSkin:
    """A flat skin on a geom of a MuJoCo model.

    model: MjModel. geom: its name. layout: of the skin. pose: of the skin's frame in the geom's,
    whose z points out of the geom. stiffness_pa_per_m: of the cover, Pa/m.
    Raises ParameterError for a geom that is not there.
    """

    def __init__(
        self,
        model: Any,
        geom: str,
        layout: Layout,
        pose: Pose,
        stiffness_pa_per_m: float = STIFFNESS_PA_PER_M,
    ) -> None:
        self._model, self._pose, self._stiffness_pa_per_m = model, pose, stiffness_pa_per_m
        self._mujoco = mujoco = import_module("mujoco")
        self._geom: int = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
        if self._geom < 0:
            raise ParameterError(f"the model has no geom {geom!r}")
        self._cover = Foundation(layout.positions_m, layout.normals, layout.areas_m2)
        self._areas_m2 = layout.areas_m2.astype(np.float64)

    def frame(self, data: Any) -> Pose:
        """The skin's frame in the world, of the state MjData."""
        return _pose_of(data, self._geom) @ self._pose

    def forces_n(self, data: Any) -> dict[int, float]:
        """Normal force of every geom that touches the skin's, N, by the other geom's number."""
        forces_n: dict[int, float] = {}
        force = np.zeros(6)
        for number in range(data.ncon):
            geoms = [int(geom) for geom in data.contact[number].geom]
            if self._geom in geoms:
                self._mujoco.mj_contactForce(self._model, data, number, force)
                [other] = [geom for geom in geoms if geom != self._geom] or [self._geom]
                forces_n[other] = forces_n.get(other, 0.0) + float(force[0])
        return forces_n

    def objects(self, data: Any) -> list[Indenter]:
        """What touches the skin in a state, for Skin.press, Skin.step or ~/sim/objects.

        Spheres, cylinders, capsules (as the cylinders between their ends) and boxes; raises
        ParameterError for other geoms.
        """
        inverse = self.frame(data).inverse
        return [
            self._pressed(self._object(geom, inverse @ _pose_of(data, geom)), force_n)
            for geom, force_n in self.forces_n(data).items()
            if force_n > 0
        ]

    def _object(self, geom: int, pose: Pose) -> Indenter:
        mujoco = self._mujoco
        kind, size = mujoco.mjtGeom(self._model.geom_type[geom]), self._model.geom_size[geom]
        common: dict[str, Any] = {
            "position_m": pose.translation_m.tolist(),
            "orientation_xyzw": pose.quaternion.tolist(),
            "stiffness_pa_per_m": self._stiffness_pa_per_m,
        }
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            return Sphere(radius_m=float(size[0]), **common)
        if kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
            return Cylinder(radius_m=float(size[0]), length_m=float(2 * size[1]), **common)
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            return Box(size_m=(2 * size).tolist(), **common)
        name = mujoco.mj_id2name(self._model, mujoco.mjtObj.mjOBJ_GEOM, geom)
        raise ParameterError(
            f"geom {name or geom} is a {kind.name}; the skin feels spheres, "
            "cylinders, capsules and boxes: give the body one of these for contacts"
        )

    def _pressed(self, thing: Indenter, force_n: float) -> Indenter:
        """The object where it touches the skin with this force, moved along the skin's normal.

        One that cannot have the force, as it touches the geom beside the skin, stays where it is.
        """
        x, y, z = thing.position_m

        def moved(depth_m: float) -> Indenter:
            return replace(thing, position_m=(x, y, z - depth_m))

        low_m, high_m, step_m = -ABOVE_M, -ABOVE_M, FIRST_M
        while self._force_n(moved(high_m)) < force_n:
            low_m, high_m, step_m = high_m, high_m + step_m, GROWTH * step_m
            if high_m > DEEPEST_M:
                return thing
        for _ in range(HALVINGS):
            middle_m = (low_m + high_m) / 2
            if self._force_n(moved(middle_m)) < force_n:
                low_m = middle_m
            else:
                high_m = middle_m
        return moved(high_m)

    def _force_n(self, *things: Indenter) -> float:
        return float(self._cover.pressure_pa(things) @ self._areas_m2)


def _pose_of(data: Any, geom: int) -> Pose:
    """A geom's frame in the world."""
    rotation: Floats = np.array(data.geom_xmat[geom]).reshape(3, 3)
    return Pose(rotation, np.array(data.geom_xpos[geom]))
