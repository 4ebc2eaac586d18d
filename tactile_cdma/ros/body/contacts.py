# SPDX-License-Identifier: Apache-2.0

"""Combines the contacts of many patches in one message, in the body's frame."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Floats
from ...messages.cdr import Heading
from ...places.poses import Pose
from ...readings.taxels import Coverage
from ..common.touches import ID, STATE, Touches

_MOST_TAXELS = 2**32 - 1
"""The largest number that the message holds."""
_TURNED = "position", "normal", "force", "velocity"
_NUMBERS = np.arange(STATE.itemsize // 8, dtype=np.float64).view(STATE)[0]
_VECTORS = np.stack([_NUMBERS[field] for field in _TURNED]).astype(np.intp)
"""(4, 3) index of each coordinate of these in a STATE as float64; the position comes first."""


def body_contacts(
    parts: Sequence[tuple[Pose, Touches]], absent: list[str], heading: Heading, sequence: int
) -> Touches:
    """Return the contacts of a body, strongest first.

    parts: each patch's pose in the body's frame, and its latest message. absent: the other patches.
    The centre of pressure weighs contacts by their forces. Sums are NaN by the rules of
    TactileContacts.msg, and where those of a touched patch are.
    """
    touched = [(pose, message) for pose, message in parts if message.patches]
    rotations = np.array([pose.rotation for pose, _ in touched]).reshape(-1, 3, 3)
    places_m = np.array([pose.translation_m for pose, _ in touched]).reshape(-1, 3)
    states = _joined([message.states for _, message in touched], STATE)
    of = [i for i, (_, message) in enumerate(touched) for _ in message.patches]
    _move(states, rotations[of], places_m[of])
    forces_n = np.sqrt(np.square(states["force"]).sum(axis=1))
    coverage = Coverage(
        min(sum(message.taxels_valid for _, message in parts), _MOST_TAXELS),
        min(sum(message.taxels_in_service for _, message in parts), _MOST_TAXELS),
    )
    untouched = coverage.is_whole and not absent and all(m.untouched for _, m in parts)
    sums = np.full(7, 0.0 if untouched else np.nan)
    if touched and coverage.is_most and len(parts) >= len(absent):
        sums = _sums([message for _, message in touched], rotations, places_m)
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
        stamp_uncertainty_s=max((m.stamp_uncertainty_s for _, m in parts), default=math.inf),
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


def _move(states: NDArray[np.void], rotations: Floats, places_m: Floats) -> None:
    """Change the states of c contacts to what the body sees; the poses of their patches: (c, …)."""
    numbers = states.view(np.float64).reshape(-1, STATE.itemsize // 8)
    vectors = numbers[:, _VECTORS] @ rotations.transpose(0, 2, 1)
    vectors[:, 0] += places_m
    numbers[:, _VECTORS] = vectors


def _joined(arrays: list[NDArray[np.void]], kind: np.dtype[np.void]) -> NDArray[np.void]:
    """Join the arrays in a new one."""
    # np.concatenate compares the fields of all arrays, which takes longer.
    return np.frombuffer(bytearray().join(array.tobytes() for array in arrays), kind)


def _sums(messages: Sequence[Touches], rotations: Floats, places_m: Floats) -> Floats:
    """Add up (7,) area (m²), force (N), torque (N m) of p patches about the body's origin.

    rotations: (p, 3, 3). places_m: (p, 3). Both: of their poses.
    """
    wrenches = np.array([(m.force_n, m.torque_nm) for m in messages])
    forces_n, torques_nm = (wrenches @ rotations.transpose(0, 2, 1)).transpose(1, 0, 2)
    torque_nm = torques_nm.sum(axis=0) + _crossed(places_m, forces_n).sum(axis=0)
    area_m2 = sum(message.area_m2 for message in messages)
    return np.array([area_m2, *forces_n.sum(axis=0), *torque_nm])


def _crossed(a: Floats, b: Floats) -> Floats:
    """Cross products of (p, 3) vectors; np.cross takes five times as long."""
    return np.asarray(a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]])
