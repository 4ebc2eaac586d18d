# SPDX-License-Identifier: Apache-2.0

"""Poses of frames: rotation and translation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Floats


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
