# SPDX-License-Identifier: Apache-2.0

"""Combines the contacts of many patches in one message, in the body's frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Floats
from ...places.poses import Pose
from ...readings.taxels import Coverage
from ..common.cdr import Heading
from ..common.touches import ID, STATE, Touches

_MOST_TAXELS = 2**32 - 1
"""The largest number that the message holds."""
_MOVED = ("position", "normal", "force", "velocity")


def body_contacts(
    parts: Sequence[tuple[Pose, Touches]], absent: list[str], heading: Heading, sequence: int
) -> Touches:
    """The contacts of a body, strongest first.

    parts: each patch's pose in the body's frame, and its latest message. absent: the other patches.
    The centre of pressure weighs contacts by their forces. Sums are NaN by the rules of
    TactileContacts.msg, and where those of a touched patch are.
    """
    touched = [(pose, message) for pose, message in parts if message.patches]
    states = _joined([_moved(message.states, pose) for pose, message in touched], STATE)
    forces_n = np.linalg.norm(states["force"], axis=1)
    coverage = Coverage(
        min(sum(message.taxels_valid for _, message in parts), _MOST_TAXELS),
        min(sum(message.taxels_in_service for _, message in parts), _MOST_TAXELS),
    )
    untouched = coverage.is_whole and not absent and all(m.untouched for _, m in parts)
    sums = np.full(7, 0.0 if untouched else np.nan)
    if touched and coverage.is_most and len(parts) >= len(absent):
        sums = _sums(touched)
    centre_m = np.full(3, np.nan)
    if forces_n.any() and np.isfinite(sums).all():
        centre_m = forces_n @ states["position"] / forces_n.sum()
    with np.errstate(over="ignore"):
        area_m2 = float(np.float32(sums[0]))
    order = np.argsort(-forces_n, kind="stable")
    patches = [patch for _, message in touched for patch in message.patches]
    taxels = [some for _, message in touched for some in message.taxels]
    return Touches(
        heading=heading,
        sequence=sequence,
        info_id=0,
        absent=absent,
        taxels_in_service=coverage.in_service,
        taxels_valid=coverage.valid,
        touched=bool(patches),
        untouched=untouched,
        area_m2=area_m2,
        position_m=centre_m,
        force_n=sums[1:4],
        torque_nm=sums[4:],
        patches=[patches[i] for i in order],
        ids=_joined([message.ids for _, message in touched], ID)[order],
        states=states[order],
        taxels=[taxels[i] for i in order],
    )


def _moved(states: NDArray[np.void], pose: Pose) -> NDArray[np.void]:
    """States of a patch's contacts as seen from the body."""
    vectors = pose.rotate(np.stack([states[field] for field in _MOVED], axis=1))
    vectors[:, 0] += pose.translation_m
    moved = states.copy()
    for column, field in enumerate(_MOVED):
        moved[field] = vectors[:, column]
    return moved


def _joined(arrays: list[NDArray[np.void]], kind: np.dtype[np.void]) -> NDArray[np.void]:
    # np.concatenate compares the fields of all arrays, which takes longer.
    return np.frombuffer(b"".join(array.tobytes() for array in arrays), kind)


def _sums(parts: Sequence[tuple[Pose, Touches]]) -> Floats:
    """(7,) area (m²), force (N) and torque (N m) of patches, about the body frame's origin."""
    rotated = [pose.rotate(np.stack([m.force_n, m.torque_nm])) for pose, m in parts]
    forces_n, torques_nm = np.stack(rotated, axis=1)
    torques_nm += np.cross([pose.translation_m for pose, _ in parts], forces_n)
    areas_m2 = [[message.area_m2] for _, message in parts]
    return np.asarray(np.hstack([areas_m2, forces_n, torques_nm]).sum(axis=0))
