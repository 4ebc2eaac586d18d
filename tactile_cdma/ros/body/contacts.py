# SPDX-License-Identifier: Apache-2.0

"""Combines the contacts of many patches in one message, in the body's frame."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
from geometry_msgs.msg import Wrench
from numpy.typing import NDArray
from std_msgs.msg import Header

from tactile_cdma.msg import TactileContact, TactileContacts

from ...places.poses import Pose
from ...readings.taxels import Coverage
from ..common.convert import point, rows, vector

_MOST_TAXELS = 2**32 - 1
"""The largest number that the message holds."""


def body_contacts(
    parts: Sequence[tuple[Pose, TactileContacts]], absent: list[str], header: Header, sequence: int
) -> TactileContacts:
    """The contacts of a body, strongest first.

    parts: each patch's pose in the body's frame, and its latest message. absent: the other patches.
    The centre of pressure weighs contacts by their forces. Sums are NaN by the rules of
    TactileContacts.msg, and where those of a touched patch are.
    """
    contacts = [contact for pose, message in parts for contact in _moved(message.contacts, pose)]
    forces_n = np.linalg.norm(rows([contact.force for contact in contacts]), axis=1)
    coverage = Coverage(
        min(sum(message.taxels_valid for _, message in parts), _MOST_TAXELS),
        min(sum(message.taxels_in_service for _, message in parts), _MOST_TAXELS),
    )
    untouched = coverage.is_whole and not absent and all(m.untouched for _, m in parts)
    touched = [(pose, message) for pose, message in parts if message.contacts]
    sums = np.full(7, 0.0 if untouched else np.nan)
    if touched and coverage.is_most and len(parts) >= len(absent):
        sums = np.sum([_sums(pose, message) for pose, message in touched], axis=0)
    centre_m = np.full(3, np.nan)
    if forces_n.any() and np.isfinite(sums).all():
        places_m = rows([contact.position for contact in contacts])
        centre_m = forces_n @ places_m / forces_n.sum()
    with np.errstate(over="ignore"):
        area_m2 = float(np.float32(sums[0]))
    return TactileContacts(
        header=header,
        sequence=sequence,
        absent=absent,
        taxels_in_service=coverage.in_service,
        taxels_valid=coverage.valid,
        touched=bool(contacts),
        untouched=untouched,
        area=area_m2,
        position=point(centre_m),
        wrench=Wrench(force=vector(sums[1:4]), torque=vector(sums[4:])),
        contacts=[contacts[i] for i in np.argsort(-forces_n, kind="stable")],
    )


def _moved(contacts: Sequence[TactileContact], pose: Pose) -> list[TactileContact]:
    """Contacts of a patch as seen from the body."""
    seen_from_patch = [[c.position, c.normal, c.force, c.velocity] for c in contacts]
    vectors = np.array([rows(four) for four in seen_from_patch]).reshape(-1, 4, 3)
    vectors = pose.rotate(vectors)
    vectors[:, 0] += pose.translation_m
    moved = [copy(contact) for contact in contacts]
    for contact, (position, normal, force, velocity) in zip(moved, vectors, strict=True):
        contact.position, contact.normal = point(position), vector(normal)
        contact.force, contact.velocity = vector(force), vector(velocity)
    return moved


def _sums(pose: Pose, message: TactileContacts) -> NDArray[np.float64]:
    """(7,) area (m²), force (N) and torque (N m) of a patch, about the body frame's origin."""
    force, torque = pose.rotate(rows([message.wrench.force, message.wrench.torque]))
    torque += np.cross(pose.translation_m, force)
    return np.concatenate([[message.area], force, torque])
