# SPDX-License-Identifier: Apache-2.0

"""Poses of coordinate frames relative to each other, from the latest transforms received.

tf2 keeps a history and interpolates to the stamp asked for. This tree keeps only the latest
transform, whatever its stamp: a patch on a moving arm is off by the arm's speed times the age of
the transform (10 ms at 1 m/s: 10 mm).
"""

import numpy as np

from ...base.errors import TransformError
from ...places.poses import Pose

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
