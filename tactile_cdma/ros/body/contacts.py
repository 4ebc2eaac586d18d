# SPDX-License-Identifier: Apache-2.0

"""Contacts of many patches in one message, in one frame."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Wrench
from std_msgs.msg import Header

from tactile_cdma.msg import TactileContact, TactileContacts

from ...places.poses import Pose
from ..common.convert import point, vector


def body_contacts(
    parts: Sequence[tuple[Pose, TactileContacts]], absent: list[str], header: Header, sequence: int
) -> TactileContacts:
    """What touches a body. parts: each patch's pose in the body's frame, and its latest message.

    The centre of pressure weighs contacts by their forces.
    """
    contacts = [pair for pose, message in parts for pair in _moved(message.contacts, pose)]
    contacts.sort(key=itemgetter(0), reverse=True)
    return TactileContacts(
        header=header,
        sequence=sequence,
        absent=absent,
        touched=bool(contacts),
        area=sum((message.area for _, message in parts), start=0.0),
        position=_centre(contacts),
        wrench=_wrench(parts),
        contacts=[contact for _, contact in contacts],
    )


def _moved(contacts: Sequence[TactileContact], pose: Pose) -> list[tuple[float, TactileContact]]:
    """Contacts as seen from the body, each after the size of its force, N."""
    if not contacts:
        return []
    seen_from_patch = [
        [_xyz(c.position), _xyz(c.normal), _xyz(c.force), _xyz(c.velocity)] for c in contacts
    ]
    vectors = pose.rotate(np.array(seen_from_patch))
    vectors[:, 0] += pose.translation_m
    forces_n = np.linalg.norm(vectors[:, 2], axis=1).tolist()
    return [
        (
            force_n,
            TactileContact(
                patch=contact.patch,
                id=contact.id,
                age=contact.age,
                position=point(position),
                normal=vector(normal),
                force=vector(force),
                area=contact.area,
                pressure_max=contact.pressure_max,
                saturated=contact.saturated,
                velocity=vector(velocity),
                force_rate=contact.force_rate,
                taxels=contact.taxels,
            ),
        )
        for contact, force_n, (position, normal, force, velocity) in zip(
            contacts, forces_n, vectors, strict=True
        )
    ]


def _centre(contacts: Sequence[tuple[float, TactileContact]]) -> Point:
    """NaN without any, or without a force."""
    forces_n = np.array([force_n for force_n, _ in contacts])
    if not forces_n.any():
        return point(np.full(3, np.nan))
    places_m = np.array([_xyz(contact.position) for _, contact in contacts])
    return point(forces_n @ places_m / forces_n.sum())


def _wrench(parts: Sequence[tuple[Pose, TactileContacts]]) -> Wrench:
    """Sum of the patches' resultants, about the origin of the body's frame."""
    force, torque = np.zeros(3), np.zeros(3)
    for pose, message in parts:
        turned = pose.rotate(np.array([_xyz(message.wrench.force), _xyz(message.wrench.torque)]))
        force += turned[0]
        torque += turned[1] + np.cross(pose.translation_m, turned[0])
    return Wrench(force=vector(force), torque=vector(torque))


def _xyz(values: Any) -> tuple[float, float, float]:
    return values.x, values.y, values.z
