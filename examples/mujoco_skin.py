# SPDX-License-Identifier: Apache-2.0

"""Contacts of MuJoCo geoms as objects on the simulated skin, to copy: pip install mujoco.

MuJoCo's bodies are nearly rigid: its contacts have forces, but no depth that a soft cover would
have. So each object that touches the skin's geoms is pressed into the cover until that answers with
MuJoCo's normal force, and the skin reads what the physics carries. examples/mujoco_grip.py and
examples/mujoco_hand.py use examples/mujoco_skin.py.
"""

from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np

from tactile_cdma import ParameterError
from tactile_cdma.base.arrays import Floats
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.poses import Pose
from tactile_cdma.sim import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Foundation,
    HeightMap,
    Indenter,
    Sphere,
    at_force,
    pressed_pa,
)
from tactile_cdma.sim.indenters import STIFFNESS_PA_PER_M

CELL_M, MOST_RAYS, BELOW_M = 1e-3, 1024, 0.03
"""Rays find the face of a mesh that touches: a grid of CELL_M, coarser for a skin that takes more
than MOST_RAYS, from BELOW_M under the skin. Chosen: 0.5 ms of rays."""
AT_HOME = Pose(np.eye(3), np.zeros(3))
PLANE_M = (100.0, 100.0, 1.0)
"""A plane is the top of a box of this size, m."""
Geom = int | np.integer | str


class MujocoSkin:
    """A skin on geoms of a MuJoCo model.

    model: MjModel. on: what it covers: a geom, by name or number, or several ones of one body; a
    body, by name, for all its geoms; or a site, for those of its body. layout: of the skin.
    pose: of the skin's frame in that of the geom, the body (of several geoms, too) or the site; its
    z points out. stiffness_pa_per_m: of the cover, Pa/m.
    Raises ParameterError for what is not there.
    """

    def __init__(
        self,
        model: Any,
        on: Geom | Sequence[Geom],
        layout: Layout,
        pose: Pose = AT_HOME,
        stiffness_pa_per_m: float = STIFFNESS_PA_PER_M,
    ) -> None:
        self._model, self._pose, self._stiffness_pa_per_m = model, pose, stiffness_pa_per_m
        self._mujoco = import_module("mujoco")
        self._kinds = self._mujoco.mjtGeom
        self._places, self._number, self._geoms = self._found(on)
        places_m, normals = layout.positions_m, layout.normals
        self._cover = Foundation(places_m, normals, layout.areas_m2, layout.aspect)
        self._out = normals[0].astype(np.float64) if (normals == normals[0]).all() else None
        low_m, high_m = places_m.min(axis=0), places_m.max(axis=0)
        self._middle_m = ((low_m + high_m) / 2).astype(np.float64)
        self._half_m = float(np.linalg.norm(high_m - low_m) / 2 + max(layout.pitches_m))

    def frame(self, data: Any) -> Pose:
        """The skin's frame in the world, of the state MjData."""
        place_m, turned = (getattr(data, name)[self._number] for name in self._places)
        return _pose(place_m, turned) @ self._pose

    def forces_n(self, data: Any) -> dict[int, float]:
        """Normal force of every geom that touches the skin's, N, by the other geom's number."""
        return {geom: force_n for geom, (force_n, _) in self._contacts(data).items()}

    def objects(self, data: Any) -> list[Indenter]:
        """What touches the skin in a state, for Skin.press, Skin.step or ~/sim/objects.

        Spheres, cylinders, capsules, boxes, ellipsoids, planes and meshes; a mesh, as a HeightMap,
        is not for the topic. Raises ParameterError for other geoms. On a flat skin an object is
        pressed along its normal, on a curved one along its force.
        """
        return [at_force(self._cover, *press) for press in self._presses(data)]

    def pressure_pa(self, data: Any) -> Floats:
        """Mean pressure of these on every taxel, (t,), Pa, for SkinBatch; quicker."""
        return pressed_pa(self._cover, self._presses(data))

    def _presses(self, data: Any) -> list[tuple[Indenter, float, list[float]]]:
        """What touches it, where MuJoCo has it; force, N, and direction in which it is pressed."""
        frame = self.frame(data)
        inverse = frame.inverse
        found = []
        for geom, (force_n, vector_n) in self._contacts(data).items():
            along = -self._out if self._out is not None else _unit(inverse.rotate(vector_n))
            if self._out is None:
                force_n = float(np.linalg.norm(vector_n))
            if force_n > 0:
                thing = self._object(data, geom, frame, inverse, along)
                found.append((thing, force_n, along.tolist()))
        return found

    def _found(self, on: Geom | Sequence[Geom]) -> tuple[tuple[str, str], int, frozenset[int]]:
        """Names in MjData of place and orientation, the number there, and the skin's geoms."""
        model, kinds = self._model, self._mujoco.mjtObj
        if isinstance(on, str):
            for kind, names, owners in (
                (kinds.mjOBJ_GEOM, ("geom_xpos", "geom_xmat"), None),
                (kinds.mjOBJ_BODY, ("xpos", "xmat"), range(model.nbody)),
                (kinds.mjOBJ_SITE, ("site_xpos", "site_xmat"), model.site_bodyid),
            ):
                number = int(self._mujoco.mj_name2id(model, kind, on))
                if number >= 0:
                    geoms = [number] if owners is None else self._of_body(int(owners[number]), on)
                    return names, number, frozenset(geoms)
            raise ParameterError(f"the model has no geom, body or site {on!r}")
        if isinstance(on, int | np.integer):
            return ("geom_xpos", "geom_xmat"), self._geom(on), frozenset([int(on)])
        numbers = [self._geom(each) for each in on]
        bodies = {int(model.geom_bodyid[number]) for number in numbers}
        if len(bodies) != 1:
            raise ParameterError(
                f"the geoms {list(on)} are of {len(bodies)} bodies; a skin has one"
            )
        return ("xpos", "xmat"), bodies.pop(), frozenset(numbers)

    def _geom(self, geom: Geom) -> int:
        number = geom
        if isinstance(geom, str):
            number = self._mujoco.mj_name2id(self._model, self._mujoco.mjtObj.mjOBJ_GEOM, geom)
        if not 0 <= int(number) < self._model.ngeom:
            raise ParameterError(f"the model has no geom {geom!r}")
        return int(number)

    def _of_body(self, body: int, name: str) -> list[int]:
        geoms = np.flatnonzero(self._model.geom_bodyid == body).tolist()
        if not geoms:
            raise ParameterError(f"{name!r} is of a body without geoms: nothing touches it")
        return geoms

    def _contacts(self, data: Any) -> dict[int, tuple[float, Floats]]:
        """By geom that touches the skin's: normal force, N, and its vector in the world."""
        found: dict[int, tuple[float, Any]] = {}
        if not data.ncon:
            return found
        force, contact = np.zeros(6), data.contact
        normals, sides = contact.frame[:, :3], contact.geom.tolist()
        for number, (one, other) in enumerate(sides):
            if (one in self._geoms) == (other in self._geoms):
                continue  # somewhere else, or within the skin's own body
            self._mujoco.mj_contactForce(self._model, data, number, force)
            normal_n = float(force[0])
            # The normal points from the first geom to the second one.
            theirs, signed_n = (one, normal_n) if other in self._geoms else (other, -normal_n)
            if theirs < 0:  # not the last one
                raise ParameterError("a flex touches the skin, which feels geoms only")
            so_far_n, vector_n = found.get(theirs, (0.0, 0.0))
            found[theirs] = so_far_n + normal_n, vector_n + signed_n * normals[number]
        return found

    def _object(self, data: Any, geom: int, frame: Pose, inverse: Pose, along: Floats) -> Indenter:
        """frame, inverse: of the skin. along: the direction in which it is pressed."""
        kinds, size = self._kinds, self._model.geom_size[geom]
        kind = kinds(self._model.geom_type[geom])
        if kind == kinds.mjGEOM_MESH:
            return self._face(data, geom, frame, along)
        pose = inverse @ _pose(data.geom_xpos[geom], data.geom_xmat[geom])
        if kind == kinds.mjGEOM_PLANE:
            pose = pose @ Pose(np.eye(3), np.array([0, 0, -PLANE_M[2] / 2]))
        shape = _shape(kind.name, *size.tolist(), self._stiffness_pa_per_m)
        if shape is not None:
            return shape.placed(pose)
        name = self._mujoco.mj_id2name(self._model, self._mujoco.mjtObj.mjOBJ_GEOM, geom)
        raise ParameterError(
            f"geom {name or geom} is a {kind.name}; the skin feels spheres, cylinders, capsules, "
            "boxes, ellipsoids, planes and meshes: give the body one of these for contacts"
        )

    def _face(self, data: Any, geom: int, frame: Pose, along: Floats) -> HeightMap:
        """The face of a mesh that touches the skin, by rays against the direction of pressing."""
        count = 2 * int(min(self._half_m / CELL_M, np.sqrt(MOST_RAYS) / 2)) + 1
        cell_m = 2 * self._half_m / (count - 1)
        map_pose = Pose(_upright(-along), self._middle_m)
        steps_m = (np.arange(count) - count // 2) * cell_m
        x, y = (part.ravel() for part in np.meshgrid(steps_m, steps_m))
        in_world = frame @ map_pose
        starts_m = in_world.apply(np.column_stack([x, y, np.full(x.size, -BELOW_M)]))
        way = np.ascontiguousarray(in_world.rotation[:, 2])
        ray = self._mujoco.mj_rayMesh
        seen_m = np.array([ray(self._model, data, geom, start_m, way) for start_m in starts_m])
        return HeightMap(
            heights_m=np.where(seen_m < 0, np.nan, seen_m - BELOW_M).reshape(count, count),
            cell_m=cell_m,
            position_m=map_pose.translation_m.tolist(),
            orientation_xyzw=map_pose.quaternion.tolist(),
            stiffness_pa_per_m=self._stiffness_pa_per_m,
        )


@lru_cache
def _shape(kind: str, x_m: float, y_m: float, z_m: float, stiffness: float) -> Indenter | None:
    """A geom of this kind and size, MuJoCo's, at home; checked once, not in every frame."""
    common: dict[str, Any] = {"position_m": (0, 0, 0), "stiffness_pa_per_m": stiffness}
    match kind:
        case "mjGEOM_SPHERE":
            return Sphere(radius_m=x_m, **common)
        case "mjGEOM_CYLINDER":
            return Cylinder(radius_m=x_m, length_m=2 * y_m, **common)
        case "mjGEOM_CAPSULE":
            return Capsule(radius_m=x_m, length_m=2 * y_m, **common)
        case "mjGEOM_PLANE":
            return Box(size_m=PLANE_M, **common)
        case "mjGEOM_BOX":
            return Box(size_m=(2 * x_m, 2 * y_m, 2 * z_m), **common)
        case "mjGEOM_ELLIPSOID":
            return Ellipsoid(size_m=(2 * x_m, 2 * y_m, 2 * z_m), **common)
    return None


def _pose(place_m: Any, turned: Any) -> Pose:
    """A frame in the world, from MjData."""
    return Pose(np.array(turned).reshape(3, 3), np.array(place_m))


def _unit(vector: Floats) -> Floats:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _upright(z: Floats) -> Floats:
    """A rotation whose z axis is this unit vector."""
    x = _unit(np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z))
    return np.column_stack([x, np.cross(z, x), z])
