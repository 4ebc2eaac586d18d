# SPDX-License-Identifier: Apache-2.0

"""Converts what touches the skin to messages: its resultant, and contact by contact."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Wrench
from std_msgs.msg import Header

from tactile_cdma.msg import TactileContact, TactileContacts

from ...readings.contact import Contacts
from ..common.convert import point, ros_array, vector


def contacts_message(
    contacts: Contacts, patch: str, header: Header, sequence: int, info_id: int
) -> TactileContacts:
    """All contacts of one frame. patch: fully qualified name of the node."""
    return TactileContacts(
        header=header,
        sequence=sequence,
        info_id=info_id,
        taxels_in_service=contacts.coverage.in_service,
        taxels_valid=contacts.coverage.valid,
        touched=len(contacts) > 0,
        untouched=contacts.untouched,
        area=contacts.total_area_m2,
        position=point(contacts.centre_m),
        wrench=wrench_of(contacts),
        contacts=_contacts(contacts, patch),
    )


def _contacts(contacts: Contacts, patch: str) -> list[TactileContact]:
    normals = contacts.normals
    return [
        TactileContact(
            patch=patch,
            id=int(contacts.ids[i]),
            age=float(contacts.age_s[i]),
            position=point(contacts.position_m[i]),
            normal=vector(normals[i]),
            force=vector(contacts.force_n[i]),
            area=float(contacts.area_m2[i]),
            pressure_max=float(contacts.pressure_max_pa[i]),
            saturated=bool(contacts.saturated[i]),
            lower_bound=bool(contacts.lower_bound[i]),
            velocity=vector(contacts.velocity_m_s[i]),
            force_rate=float(contacts.force_rate_n_s[i]),
            taxels=ros_array(contacts.taxels[i].astype(np.uint16)),
        )
        for i in range(len(contacts))
    ]


def wrench_of(contacts: Contacts) -> Wrench:
    """The resultant of all contacts about the origin of the skin's frame; NaN if there is none."""
    return Wrench(force=vector(contacts.total_force_n), torque=vector(contacts.total_torque_nm))
