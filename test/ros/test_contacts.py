# SPDX-License-Identifier: Apache-2.0

"""Contacts and wrench over real DDS: consistent with the array of their frame, only on demand."""

import math
import time
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from tactile_cdma.msg import TactileArray, TactileContacts
from tactile_cdma.readings.status import Status
from tactile_cdma.ros.driver.frames import COUNTED_S
from tactile_cdma.ros.driver.markers import BLIND, SURFACE
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.views.heatmap import NO_READING_RGB
from tactile_cdma.wire._protocol import Result
from tactile_cdma.wire.messages import Ask, Command
from test.support.boards import plugged
from test.support.skin_client import Client, running, xyz
from test.support.waiting import wait_for

PITCH_M = 7e-3
PERIOD_S = 12.8e-3


def stamp_of(message: Any) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


def test_contacts_wrench_and_array_of_a_frame_belong_together() -> None:
    with running(port="sim://?scene=moving&seed=1&threshold=0") as (_, client):
        lists = client.heard(TactileContacts, "/skin/contacts", 1000)
        wrenches = client.heard(WrenchStamped, "/skin/wrench", 1000)
        wait_for(lambda: len(lists) > 60 and len(wrenches) > 60)
    arrays = {stamp_of(array): array for array in client.arrays}
    forces = {stamp_of(wrench): wrench for wrench in wrenches}
    matched = [m for m in lists if stamp_of(m) in arrays and stamp_of(m) in forces]
    assert len(matched) > 50
    for message in matched:
        array, wrench = arrays[stamp_of(message)], forces[stamp_of(message)]
        assert message.header == array.header == wrench.header
        assert (message.sequence, message.info_id) == (array.sequence, array.info_id)
        assert message.wrench == wrench.wrench
        assert message.touched and message.contacts
        force = sum(xyz(contact.force) for contact in message.contacts)
        assert xyz(wrench.wrench.force) == pytest.approx(force, abs=1e-9)
        assert_is_in(message, array)


def assert_is_in(message: TactileContacts, array: TactileArray) -> None:
    """The contacts are what the array's pressures say."""
    pressure_pa = np.array(array.pressure)
    touched = sorted(taxel for contact in message.contacts for taxel in contact.taxels)
    assert touched == np.flatnonzero(pressure_pa > 500).tolist()
    load_n = pressure_pa[pressure_pa > 150].sum() * PITCH_M**2
    assert -message.wrench.force.z == pytest.approx(load_n, rel=1e-5)
    assert message.area == pytest.approx(len(touched) * PITCH_M**2, rel=1e-5)
    strongest = max(message.contacts, key=lambda contact: -contact.force.z)
    assert strongest is message.contacts[0]
    assert strongest.pressure_max == pytest.approx(pressure_pa.max())
    assert xyz(strongest.normal) == pytest.approx([0, 0, 1])
    torque = np.cross(xyz(message.position), xyz(message.wrench.force))
    assert xyz(message.wrench.torque) == pytest.approx(torque, abs=1e-6)


def test_an_untouched_skin_has_an_empty_list_in_every_frame_and_zeros_once_all_is_heard() -> None:
    """A wrench that is unknown is not published where that is not wanted, but as soon as it is."""
    with running(port="sim://?scene=idle", publish_unknown_wrench=False) as (_, client):
        lists = client.heard(TactileContacts, "/skin/contacts", 1000)
        wrenches = client.heard(WrenchStamped, "/skin/wrench", 1000)
        wait_for(lambda: len([message for message in lists if message.untouched]) > 40)
        wait_for(lambda: len(wrenches) > 5)
    assert all(xyz(message.wrench.force).tolist() == [0.0] * 3 for message in wrenches)
    for message in lists:
        assert not message.touched
        assert not message.contacts
        assert message.taxels_in_service == 16
        assert message.untouched == (message.taxels_valid == 16)
        assert math.isnan(message.position.x)
        sums = message.area, message.wrench.force.z, message.wrench.torque.x
        assert sums == (0.0, 0.0, 0.0) if message.untouched else all(map(math.isnan, sums))
    assert_go_with(lists, client.arrays)


def assert_go_with(lists: list[Any], arrays: list[Any]) -> None:
    """Every frame since the first list has one; on a busy machine the driver may skip some."""
    sequences = [message.sequence for message in lists]
    frames = [array.sequence for array in arrays]
    begin, end = max(sequences[0], frames[0]), min(sequences[-1], frames[-1])
    assert end > begin
    of_lists, of_frames = (
        [sequence for sequence in some if begin <= sequence <= end] for some in (sequences, frames)
    )
    assert of_lists == of_frames


@pytest.mark.parametrize(("dead", "valid"), [(range(1, 17), 0), ([6], 15)])
def test_what_dead_nodes_would_feel_is_unknown(dead: Iterable[int], valid: int) -> None:
    """The fingertip presses node 6; all nodes are dead, or that one alone."""
    port = f"sim://?scene=press&dead={','.join(map(str, dead))}"
    with running(port=port) as (_, client):
        lists = client.heard(TactileContacts, "/skin/contacts", 1000)
        wrenches = client.heard(WrenchStamped, "/skin/wrench", 1000)
        markers = client.heard(MarkerArray, "/skin/markers", 1000)
        images, clouds = (
            client.heard(kind, f"/skin/{topic}", 1000)
            for kind, topic in ((Image, "pressure_image"), (PointCloud2, "points"))
        )
        wait_for(lambda: sum(m.taxels_valid == valid for m in lists) > 4 / 0.0128)  # on and off
        assert client.set(publish_unknown_wrench=False) == (True, "")

        def has_ended() -> bool:
            known, before = len(wrenches), len(lists)
            wait_for(lambda: len(lists) > before + 20)
            return len(wrenches) == known  # none is on its way any more

        wait_for(has_ended)
        # of the last messages, too, on a machine that was busy amid them
        wait_for(lambda: all(m.taxels_valid == valid for m in lists[-20:]))
    for message in lists:
        assert not message.touched and not message.untouched and not message.contacts
        assert message.taxels_in_service == 16
        sums = message.area, *xyz(message.wrench.force), *xyz(message.wrench.torque)
        assert np.isnan(sums).all() and np.isnan(xyz(message.position)).all()
    assert wrenches and all(math.isnan(wrench.wrench.force.z) for wrench in wrenches)
    [text] = [marker.text for marker in markers[-1].markers if marker.ns == BLIND]
    assert text == f"unread:{16 - valid}/16"
    [unread] = np.nonzero(np.isnan(np.frombuffer(images[-1].data, np.float32)))
    assert unread.tolist() == [node - 1 for node in dead]
    assert clouds[-1].width == valid
    [surface] = [marker for marker in markers[-1].markers if marker.ns == SURFACE]
    of_taxels = np.array([(c.r, c.g, c.b) for c in surface.colors]).reshape(16, 6, 3)
    grey = np.isclose(of_taxels * 255, NO_READING_RGB).all(axis=(1, 2))
    assert np.flatnonzero(grey).tolist() == unread.tolist()


class Lossy(VirtualDigitizer):
    """Loses what it sends until a time: two frames, as single packets may hold none.

    Of older firmware, it asks no nodes to speak.
    """

    until_s = 0.0

    def _obey(self, command: Command) -> None:
        if isinstance(command, Ask):
            self._send(command.ack(Result.UNKNOWN_COMMAND))
        else:
            super()._obey(command)

    def take(self, most: int) -> bytes:
        data = super().take(most)
        return b"" if time.monotonic() < self.until_s else data


def test_untouched_is_not_claimed_after_a_loss_until_every_node_was_heard_again() -> None:
    lossy = Lossy(SimOptions(scene="idle", heartbeat=20))
    with plugged(lambda: lossy) as tty, running(port=tty, idle_rate_hz=1.0) as (_, client):
        lists = client.heard(TactileContacts, "/skin/contacts", 1000)
        wait_for(lambda: lists and lists[-1].untouched)
        before = lists[-1].sequence
        lossy.until_s = time.monotonic() + 0.03
        wait_for(lambda: any(m.sequence > before and not m.untouched for m in lists))
        wait_for(lambda: lists[-1].untouched)
        arrays = {array.sequence: np.asarray(array.status) for array in client.arrays}
    unknown = [m.sequence for m in lists if m.sequence > before and not m.untouched]
    assert unknown[-1] - unknown[0] >= 10  # heartbeats come within 20 frames
    assert not any(m.touched for m in lists)
    for message in lists:
        if message.sequence > before and message.sequence in arrays:
            status = arrays[message.sequence]
            unheard = status & TactileArray.STATUS_UNHEARD == TactileArray.STATUS_UNHEARD
            assert message.untouched == (not unheard.any())
            assert message.taxels_valid == 16 - np.count_nonzero(unheard)


def test_silence_can_be_published_less_often_on_all_topics_and_touch_always_is() -> None:
    def silent(message: TactileArray) -> bool:
        return bool((np.asarray(message.status) & Status.SILENT).all())

    port = "sim://?scene=press&heartbeat=0"
    with running(port=port, idle_rate_hz=5.0) as (_, client):
        lists = client.heard(TactileContacts, "/skin/contacts", 1000)
        wait_for(lambda: sum(map(silent, client.arrays)) > 8)
        wait_for(lambda: sum(not silent(m) for m in client.arrays) > 60)
        assert client.set(idle_rate_hz=0.0) == (True, "")
    assert_go_with(lists, client.arrays)
    gaps = {"silence": set[int](), "touch": set[int]()}
    for one, other in pairwise(client.arrays):
        both_silent = silent(one) and silent(other)
        gaps["silence" if both_silent else "touch"].add(other.sequence - one.sequence)
    assert 15 in gaps["silence"] or 16 in gaps["silence"]  # 0.2 s are 15.6 frames
    talking = [m.sequence for m in client.arrays if not silent(m)]
    runs = np.diff(talking)
    assert np.count_nonzero(runs == 1) > 50  # no frame of a touch is left out


def test_contacts_are_followed_only_while_somebody_subscribes() -> None:
    """Ids and ages would tell if contacts that came and went before had been counted."""
    with running(port="sim://?scene=press&threshold=0") as (node, client):
        presses: list[bool] = []
        wait_for(lambda: _pressed(client, presses) >= 2)
        for first_id in (1, 2):
            begun = client.arrays[-1].sequence
            lists = client.heard(TactileContacts, "/skin/contacts", 1000)
            wait_for(lambda lists=lists: any(message.touched for message in lists))
            first = next(message for message in lists if message.touched)
            [contact] = first.contacts
            assert contact.id == first_id
            assert contact.age <= PERIOD_S * (first.sequence - begun)
            client.unsubscribe("/skin/contacts")
            wait_for(lambda: not node.count_subscribers("/skin/contacts"))
            heard = len(client.arrays)
            unnoticed = heard + 2 * COUNTED_S / PERIOD_S
            wait_for(lambda unnoticed=unnoticed: len(client.arrays) > unnoticed)


def _pressed(client: Client, history: list[bool]) -> int:
    """How many times the skin was pressed and let go so far."""
    history[:] = [bool(np.nanmax(array.pressure) > 2e3) for array in list(client.arrays)]
    return sum(before and not now for before, now in pairwise(history))


def test_thresholds_change_at_once_and_contradictions_are_refused() -> None:
    with running(port="sim://?scene=all&threshold=0") as (_, client):
        lists = client.heard(TactileContacts, "/skin/contacts", 1000)
        wait_for(lambda: lists and lists[-1].touched)
        taken, reason = client.set(contact_kpa=0.4)
        assert not taken
        assert "release_kpa is 0.5 kPa, above contact_kpa" in reason
        assert client.set(contact_kpa=130.0) == (True, "")
        assert client.set(release_kpa=129.0) == (True, "")
        wait_for(lambda: not lists[-1].touched)
        assert client.set(release_kpa=0.5) == (True, "")
        assert client.set(contact_kpa=1.0) == (True, "")
        wait_for(lambda: lists[-1].touched)
        assert min(contact.id for contact in lists[-1].contacts) > 1
