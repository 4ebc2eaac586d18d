# SPDX-License-Identifier: Apache-2.0

"""Poses of coordinate frames: rotation and translation, and the tree of the latest ones received.

tf2 keeps a history and interpolates to the stamp asked for. This tree keeps only the latest
transform, whatever its stamp: a patch on a moving arm is off by the arm's speed times the age of
the transform (10 ms at 1 m/s: 10 mm).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Floats
from ..base.errors import TransformError


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A frame in its parent: p_parent = rotation · p + translation_m.

    rotation: (3, 3) float64, proper (orthogonal, determinant 1). translation_m: (3,) float64, m.
    """

    rotation: Floats
    translation_m: Floats

    @classmethod
    def of_rpy(cls, xyz_m: Sequence[float], rpy_rad: Sequence[float]) -> Pose:
        """Make a pose of roll, pitch, yaw about the parent's fixed axes, in this order, as URDF."""
        (sr, sp, sy), (cr, cp, cy) = np.sin(rpy_rad), np.cos(rpy_rad)
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        return cls(yaw @ pitch @ roll, np.array(xyz_m, dtype=np.float64))

    @classmethod
    def of_quaternion(cls, xyz_m: Sequence[float], xyzw: Sequence[float]) -> Pose:
        """Make a pose of a translation and a quaternion of any length, as in ROS messages.

        Raises ValueError for a zero or non-finite quaternion and for a non-finite translation.
        """
        if not all(map(math.isfinite, xyz_m)):
            raise ValueError(f"not a translation: {tuple(xyz_m)}")
        length = math.hypot(*xyzw)
        if not (length > 0 and math.isfinite(length)):
            raise ValueError(f"not a rotation: quaternion {tuple(xyzw)}")
        x, y, z, w = np.asarray(xyzw, dtype=np.float64) / length
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # cross @ p is (x, y, z) × p
        rotation = np.eye(3) + 2 * (w * cross + cross @ cross)
        return cls(rotation, np.array(xyz_m, dtype=np.float64))

    @property
    def quaternion(self) -> Floats:
        """Return the rotation as (4,) float64: x, y, z, w, of length 1, w ≥ 0."""
        (a, b, c), (d, e, f), (g, h, i) = self.rotation.tolist()
        # 4·q·qᵀ: the row with the largest diagonal entry is the most accurate (Markley 2008).
        rows = (
            (1 + a - e - i, b + d, c + g, h - f),
            (b + d, 1 - a + e - i, f + h, c - g),
            (c + g, f + h, 1 - a - e + i, d - b),
            (h - f, c - g, d - b, 1 + a + e + i),
        )
        row = rows[max(range(4), key=lambda n: rows[n][n])]
        return np.array(row) * (math.copysign(1.0, row[3]) / math.hypot(*row))

    @property
    def inverse(self) -> Pose:
        """Return the parent's pose in this frame."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation_m)

    def __matmul__(self, other: Pose) -> Pose:
        """Chain poses: self is b in a, other is c in b; returns c in a."""
        return Pose(self.rotation @ other.rotation, self.apply(other.translation_m))

    def apply(self, points_m: Floats) -> Floats:
        """Map points (…, 3), m, from this frame to the parent."""
        return self.rotate(points_m) + self.translation_m

    def rotate(self, vectors: Floats) -> Floats:
        """Turn vectors (…, 3), such as normals and forces, from this frame to the parent."""
        return np.asarray(vectors @ self.rotation.T)


MOST_FRAMES = 10_000
"""Chosen, far above any robot's number: a sender that invents names must not exhaust memory."""


class TfTree:
    """Every frame's pose in its parent; a repeated frame replaces the earlier pose."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}
        self._found: dict[tuple[str, str], Pose] = {}  # poses asked for since the last put

    def put(self, parent: str, child: str, pose: Pose) -> None:
        """Store the pose of child in parent.

        Raises TransformError for a frame that is its own parent, and for too many frames.
        """
        parent, child = _plain(parent), _plain(child)
        if parent == child:
            raise TransformError(f"frame {child!r} is given as its own parent")
        if child not in self._parents and len(self._parents) >= MOST_FRAMES:
            raise TransformError(
                f"more than {MOST_FRAMES} tf frames: is a node inventing frame names?"
            )
        self._parents[child] = (parent, pose)
        self._found.clear()

    def pose(self, target: str, source: str) -> Pose:
        """Return the pose of source in target: target.point = pose.apply(source.point).

        Raises TransformError, naming the frames, if they are not connected.
        """
        target, source = _plain(target), _plain(source)
        if found := self._found.get((target, source)):
            return found
        down, up = self._to_root(target), self._to_root(source)
        for frame, pose in up.items():
            if frame in down:
                self._found[target, source] = found = down[frame].inverse @ pose
                return found
        raise TransformError(
            f"no transform from {source!r} to {target!r}: {source!r} hangs from {list(up)[-1]!r}, "
            f"{target!r} from {list(down)[-1]!r}; set parent_frame and mount_xyz_m of the patch, "
            "or start what publishes the robot's frames"
        )

    def root(self, frame: str) -> tuple[str, Pose]:
        """Return the root above a frame, possibly the frame itself, and the frame's pose in it.

        Raises TransformError where frames form a cycle.
        """
        return list(self._to_root(_plain(frame)).items())[-1]

    def _to_root(self, frame: str) -> dict[str, Pose]:
        """Return the pose of a frame in itself, in its parent, and so on to the root."""
        pose = Pose(np.eye(3), np.zeros(3))
        poses = {frame: pose}
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in poses:
                raise TransformError(f"tf frames form a cycle: {' → '.join(poses)}")
            pose = step @ pose
            poses[frame] = pose
        return poses


def _plain(frame: str) -> str:
    """Return the name without the leading slash that older nodes write."""
    return frame.removeprefix("/")
