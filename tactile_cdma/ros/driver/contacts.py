# SPDX-License-Identifier: Apache-2.0

"""Publishes what touches the skin, as a resultant and contact by contact, while subscribed to."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Wrench, WrenchStamped
from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import Header

from tactile_cdma.msg import TactileContact, TactileContacts

from ...driver.pipeline import TactileFrame
from ...places.layout import Layout
from ...readings.contact import Contacts, ContactThresholds, ContactTracker
from ..common.convert import point, ros_array, vector
from ..common.qos import RELIABLE


class ContactPublishers:
    """`~/wrench` and `~/contacts` of a node; no id of a contact is used twice in its life."""

    def __init__(self, node: LifecycleNode) -> None:
        self._wrench = node.create_lifecycle_publisher(WrenchStamped, "~/wrench", RELIABLE)
        self._contacts = node.create_lifecycle_publisher(TactileContacts, "~/contacts", RELIABLE)
        self._tracker: ContactTracker | None = None
        self._patch = node.get_fully_qualified_name()

    @property
    def asked(self) -> bool:
        """Whether anybody subscribes."""
        return bool(
            self._wrench.get_subscription_count() or self._contacts.get_subscription_count()
        )

    def start(self, layout: Layout, thresholds: ContactThresholds) -> None:
        """Prepare for the frames of a stream."""
        first_id = self._tracker.next_id if self._tracker else 1
        self._tracker = ContactTracker(layout, thresholds, first_id)

    def change(self, thresholds: ContactThresholds) -> None:
        """Use other thresholds from the next frame on."""
        if self._tracker:
            self._tracker.thresholds = thresholds

    def take(self, frame: TactileFrame, header: Header | None, info_id: int) -> None:
        """Follow the contacts into the next frame, and publish them, unless header is None."""
        assert self._tracker is not None
        if not self.asked:
            self._tracker.forget()
            return
        contacts = self._tracker.update(frame.readings, frame.t_middle)
        if header is None:
            return
        if self._wrench.get_subscription_count():
            self._wrench.publish(WrenchStamped(header=header, wrench=_wrench(contacts)))
        if self._contacts.get_subscription_count():
            self._contacts.publish(
                contacts_message(contacts, self._patch, header, frame.sequence, info_id)
            )


def contacts_message(
    contacts: Contacts, patch: str, header: Header, sequence: int, info_id: int
) -> TactileContacts:
    """All contacts of one frame. patch: fully qualified name of the node."""
    return TactileContacts(
        header=header,
        sequence=sequence,
        info_id=info_id,
        touched=len(contacts) > 0,
        area=float(contacts.area_m2.sum()),
        position=point(contacts.centre_m),
        wrench=_wrench(contacts),
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
            velocity=vector(contacts.velocity_m_s[i]),
            force_rate=float(contacts.force_rate_n_s[i]),
            taxels=ros_array(contacts.taxels[i].astype(np.uint16)),
        )
        for i in range(len(contacts))
    ]


def _wrench(contacts: Contacts) -> Wrench:
    return Wrench(
        force=vector(contacts.force_n.sum(axis=0)), torque=vector(contacts.torque_nm.sum(axis=0))
    )
