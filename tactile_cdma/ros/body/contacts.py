# SPDX-License-Identifier: Apache-2.0

"""Combines the contacts of many patches in one message, in the body's frame."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
from geometry_msgs.msg import Wrench
from std_msgs.msg import Header

from tactile_cdma.msg import TactileContact, TactileContacts

from ...places.poses import Pose
from ..common.convert import point, rows, vector


def body_contacts(
    parts: Sequence[tuple[Pose, TactileContacts]], absent: list[str], header: Header, sequence: int
) -> TactileContacts:
    """The contacts of a body, strongest first.

    parts: each patch's pose in the body's frame, and its latest message. The centre of pressure
    weighs contacts by their forces; it is NaN without any.
    """
    contacts = [contact for pose, message in parts for contact in _moved(message.contacts, pose)]
    forces_n = np.linalg.norm(rows([contact.force for contact in contacts]), axis=1)
    centre_m = np.full(3, np.nan)
    if forces_n.any():
        places_m = rows([contact.position for contact in contacts])
        centre_m = forces_n @ places_m / forces_n.sum()
    return TactileContacts(
        header=header,
        sequence=sequence,
        absent=absent,
        touched=bool(contacts),
        area=sum((message.area for _, message in parts), start=0.0),
        position=point(centre_m),
        wrench=_wrench(parts),
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


def _wrench(parts: Sequence[tuple[Pose, TactileContacts]]) -> Wrench:
    """Sum of the patches' resultants, about the origin of the body's frame."""
    force, torque = np.zeros(3), np.zeros(3)
    for pose, message in parts:
        turned = pose.rotate(rows([message.wrench.force, message.wrench.torque]))
        force += turned[0]
        torque += turned[1] + np.cross(pose.translation_m, turned[0])
    return Wrench(force=vector(force), torque=vector(torque))
