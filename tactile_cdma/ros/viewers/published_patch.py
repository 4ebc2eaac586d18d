# SPDX-License-Identifier: Apache-2.0

"""A patch in the Rerun viewer, by the messages of its driver."""

import numpy as np
import rerun as rr
from diagnostic_msgs.msg import DiagnosticArray

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo

from ...base.errors import MessageError
from ...views.rerun_scene import PatchScene, Touches
from ..common.convert import nanoseconds, readings_of, rows
from .complaints import LEVELS, Complaints
from .patches import layout_of

_TEXT_LEVELS = {"OK": "INFO", "STALE": "WARN"}
"""Rerun's words for levels of diagnostics, where they differ."""


class PublishedPatch(PatchScene):
    """A scene that takes messages. frame_id: of its layout; empty: none came yet."""

    def __init__(self, recording: rr.RecordingStream, path: str, index: int, max_pa: float) -> None:
        super().__init__(recording, path, index, max_pa)
        self.frame_id = ""
        self._complaints = Complaints(path)

    def take_info(self, message: TactileSkinInfo) -> None:
        """Take the geometry for the frames that follow."""
        self.place(layout_of(message))
        self.frame_id = message.header.frame_id

    def take_array(self, message: TactileArray) -> None:
        """Take a frame's pressures."""
        stamp_ns = nanoseconds(message.header.stamp)
        self.take_frame(stamp_ns, message.device_time_us, *readings_of(message))

    def take_contact_list(self, message: TactileContacts) -> None:
        """Take a frame's contacts."""
        contacts = message.contacts
        position_m = rows([contact.position for contact in contacts])
        force_n = rows([contact.force for contact in contacts])
        if not (np.isfinite(position_m).all() and np.isfinite(force_n).all()):
            raise MessageError(f"frame {message.sequence} has contacts without a place or force")
        ids, lower_bound = [c.id for c in contacts], [c.lower_bound for c in contacts]
        total_n = float(np.linalg.norm(rows([message.wrench.force])))
        touches = Touches(ids, position_m, force_n, lower_bound)
        self.take_contacts(nanoseconds(message.header.stamp), touches, total_n)

    def take_diagnostics(self, message: DiagnosticArray) -> None:
        """Log what has changed in the entries of the driver."""
        for entry in self._complaints.take(message):
            level = _TEXT_LEVELS.get(LEVELS[entry.level], LEVELS[entry.level])
            stamp_ns = nanoseconds(message.header.stamp)
            self.say(stamp_ns, f"{entry.name}: {entry.message}", level)
