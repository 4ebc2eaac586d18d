# SPDX-License-Identifier: Apache-2.0

"""Converts the contacts of a frame to their message."""

import numpy as np

from ...driver.pipeline import TactileFrame
from ...messages.cdr import Heading
from ...readings.contact import Contacts
from ..common.touches import ID, STATE, Touches


def contacts_message(
    contacts: Contacts, frame: TactileFrame, patch: str, heading: Heading, info_id: int
) -> bytes:
    """All contacts of a frame. patch: fully qualified name of the node."""
    ids = np.empty(len(contacts), dtype=ID)
    ids["id"], ids["age"] = contacts.ids, contacts.age_s
    states = np.zeros(len(contacts), dtype=STATE)
    for field, values in {
        "position": contacts.position_m,
        "normal": contacts.normals,
        "force": contacts.force_n,
        "area": contacts.area_m2,
        "pressure_max": contacts.pressure_max_pa,
        "saturated": contacts.saturated,
        "lower_bound": contacts.lower_bound,
        "velocity": contacts.velocity_m_s,
        "force_rate": contacts.force_rate_n_s,
        "taxels": [len(taxels) for taxels in contacts.taxels],
    }.items():
        states[field] = values
    return Touches(
        heading=heading,
        sequence=frame.sequence,
        info_id=info_id,
        stamp_uncertainty_s=frame.stamp_uncertainty_s,
        absent=[],
        taxels_in_service=contacts.coverage.in_service,
        taxels_valid=contacts.coverage.valid,
        touched=contacts.touched,
        untouched=contacts.untouched,
        area_m2=contacts.total_area_m2,
        position_m=contacts.centre_m,
        force_n=contacts.total_force_n,
        torque_nm=contacts.total_torque_nm,
        patches=[patch] * len(contacts),
        ids=ids,
        states=states,
        taxels=[taxels.astype("<u2").tobytes() for taxels in contacts.taxels],
    ).message
