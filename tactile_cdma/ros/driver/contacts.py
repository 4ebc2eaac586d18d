# SPDX-License-Identifier: Apache-2.0

"""Converts the contacts of a frame to their message.

It is written in one piece, as every frame has one: 9 µs with one contact, where a Touches, which
receivers make of it, takes 20. The layout of a contact is that of `common/touches.py`.
"""

from struct import Struct

from ...driver.pipeline import TactileFrame
from ...messages.cdr import ENCAPSULATION, PADDING, Heading, string
from ...readings.contact import Contacts
from ..common.touches import ID, STATE, packer

_FRAME = Struct("<QIfIII??2xf4x9dI")
"""From sequence to the number of contacts, none absent between; it begins at a multiple of 8."""
_ID, _STATE = packer(ID), packer(STATE)


def contacts_message(
    contacts: Contacts, frame: TactileFrame, patch: str, heading: Heading, info_id: int
) -> bytes:
    """Return all contacts of a frame. patch: fully qualified name of the node."""
    coverage, header, name = contacts.coverage, heading.fields, string(patch)
    name += PADDING[-len(name) % 4]
    about = frame.sequence, info_id, frame.stamp_uncertainty_s, 0
    seen = coverage.in_service, coverage.valid, contacts.touched, contacts.untouched
    parts = [ENCAPSULATION, header, PADDING[-len(header) % 8]]
    parts.append(_FRAME.pack(*about, *seen, *contacts.resultant.tolist(), len(contacts)))
    end = _FRAME.size
    for number, age_s, course, normal, moments, peak_pa, saturated, at_least, taxels in zip(
        *(contacts.ids.tolist(), contacts.age_s.tolist(), contacts.course.tolist()),
        *(contacts.normals.tolist(), contacts.moments.tolist(), contacts.pressure_max_pa.tolist()),
        *(contacts.saturated.tolist(), contacts.lower_bound.tolist(), contacts.taxels),
        strict=True,
    ):
        parts += PADDING[-end % 4], name, _ID.pack(number, age_s)
        end += -end % 4 + len(name) + _ID.size
        place, motion, size = course[:3], course[4:], len(taxels)
        sums = *moments[4:7], moments[10], peak_pa, saturated, at_least
        state = _STATE.pack(*place, *normal, *sums, *motion, size)
        parts += PADDING[-end % 8], state, taxels.astype("<u2").tobytes()
        end += -end % 8 + len(state) + 2 * size
    return b"".join(parts)
