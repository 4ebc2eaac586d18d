# SPDX-License-Identifier: Apache-2.0

"""Publishes every frame for machines: array, contacts and wrench, and the info they go with."""

import math
from struct import Struct

from geometry_msgs.msg import WrenchStamped
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import qos_profile_sensor_data

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo

from ...config.parameters import Values
from ...config.skin_config import SkinConfig
from ...driver.digitizer import Source
from ...driver.pipeline import TactileFrame
from ...messages.cdr import ENCAPSULATION, PADDING, Heading, string, tactile_array
from ...readings.contact import Contacts, ContactThresholds, ContactTracker
from ...readings.taxels import Taxels
from ..common.convert import publish_wrench, skin_info
from ..common.qos import LATCHED, RELIABLE
from ..common.touches import ID, STATE, packer
from .stamps import Stamps

COUNTED_S = 0.2
"""s between counts of the subscribers. Chosen: three counts took 78 µs after a pause of one frame,
publishing 120; and a subscriber needs about as long to be discovered."""


class FramePublishers:
    """`~/tactile`, `~/contacts`, `~/wrench` and `~/info` of one skin.

    latest: the newest frame and its messages' heading (None: not published); None before the first
    frame.
    """

    def __init__(self, node: LifecycleNode, live: Values, stamps: Stamps) -> None:
        self._live, self._stamps = live, stamps
        create = node.create_lifecycle_publisher
        self._array = create(TactileArray, "~/tactile", qos_profile_sensor_data)
        self._info = create(TactileSkinInfo, "~/info", LATCHED)
        self._wrench = create(WrenchStamped, "~/wrench", RELIABLE)
        self._contacts = create(TactileContacts, "~/contacts", RELIABLE)
        # Without rclpy's checks, which take 25 µs after a pause of a frame.
        self._send_array = self._array.handle.publish_raw
        self._patch = node.get_fully_qualified_name()
        self.latest: tuple[TactileFrame, Heading | None] | None = None
        self._tracker: ContactTracker | None = None
        self._is_tracking = False
        self._info_id = 0
        self._asked: tuple[bool, ...] = (False, False, False)
        self._counted_s = -math.inf  # host time
        self._silence_due_s = 0.0  # device time from which a frame without words is published again
        self.topic = self._array.topic_name

    def start(self, config: SkinConfig) -> None:
        """Prepare for the frames of a stream; no id of a contact is used twice in a node's life."""
        self._layout = config.layout
        first_id = self._tracker.next_id if self._tracker else 1
        self._tracker = ContactTracker(config.layout, config.contact, first_id)
        self._is_tracking = False

    def stop(self) -> None:
        self.latest = None

    def change(self, thresholds: ContactThresholds) -> None:
        """Find contacts by other thresholds from the next frame on."""
        if self._tracker:
            self._tracker.thresholds = thresholds

    def publish_info(self, config: SkinConfig, source: Source, taxels: Taxels) -> None:
        """Publish what frames from now on are read with; call it between frames."""
        self._info_id += 1
        self._info.publish(skin_info(config, source, taxels, self._stamps.now(), self._info_id))

    def publish(self, frame: TactileFrame) -> None:
        """Publish a frame.

        Runs in the driver's thread: from a decoded frame to the wire it is one publish.
        """
        assert self._tracker is not None
        array, wrench, contacts = self._asked_for(frame.t_host)
        heading = None
        if self._is_news(frame) and (array or wrench or contacts):
            heading = self._stamps.rising(frame.t_host)
        if heading and array:
            with_voltage = bool(self._live["publish_voltage"])
            self._send_array(
                tactile_array(frame, self._layout, heading, self._info_id, with_voltage)
            )
        self.latest = frame, heading
        if not (wrench or contacts):
            if self._is_tracking:
                self._tracker.forget()
                self._is_tracking = False
            return
        self._is_tracking = True
        found = self._tracker.update(frame.readings, frame.t_middle)
        if heading and wrench:
            publish_wrench(self._wrench, self._live, heading, *found.wrench.reshape(2, 3))
        if heading and contacts:
            self._contacts.publish(
                contacts_message(found, frame, self._patch, heading, self._info_id)
            )

    def _asked_for(self, t_host: float) -> tuple[bool, ...]:
        """Tell who subscribes to array, wrench and contacts, as of COUNTED_S ago or less."""
        if not 0.0 <= t_host - self._counted_s < COUNTED_S:
            self._counted_s = t_host
            topics = self._array, self._wrench, self._contacts
            self._asked = tuple(topic.get_subscription_count() > 0 for topic in topics)
        return self._asked

    def _is_news(self, frame: TactileFrame) -> bool:
        """Tell whether a node spoke, or may have, or the last silent frame is long enough ago."""
        rate_hz, last = float(self._live["idle_rate_hz"]), self.latest
        if not rate_hz or frame.words.active.any():
            self._silence_due_s = 0.0  # the first silent frame tells who fell silent
            return True
        follows = last is not None and frame.sequence == last[0].sequence + 1
        is_sure = follows and not frame.words.doubtful.any()
        # Device time may start again, from nearly zero.
        if is_sure and 0.0 <= self._silence_due_s - frame.t_middle <= 1 / rate_hz:
            return False
        self._silence_due_s = frame.t_middle + 1 / rate_hz
        return True


_FRAME = Struct("<QIfIII??2xf4x9dI")
"""From sequence to the number of contacts, none absent between; it begins at a multiple of 8."""
_ID, _STATE = packer(ID), packer(STATE)


def contacts_message(
    contacts: Contacts, frame: TactileFrame, patch: str, heading: Heading, info_id: int
) -> bytes:
    """Return all contacts of a frame. patch: fully qualified name of the node.

    It is written in one piece, as every frame has one: 9 µs with one contact, where a Touches,
    which receivers make of it, takes 20. The layout of a contact is that of common/touches.py.
    """
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
