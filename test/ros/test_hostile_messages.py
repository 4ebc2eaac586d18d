# SPDX-License-Identifier: Apache-2.0

"""Messages that lie in their fields: they end nobody who reads them, and are not believed."""

import os
import re
from array import array
from collections.abc import Callable, Iterator
from functools import partial
from random import Random
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, Point32, TransformStamped, Vector3
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from tactile_cdma.base.errors import MessageError, TactileError
from tactile_cdma.msg import TactileArray, TactileContact, TactileContacts, TactileSkinInfo
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.client import SkinClient
from tactile_cdma.ros.common.touches import Touches
from tactile_cdma.ros.viewers.body_view import BodyViewer, line
from tactile_cdma.ros.viewers.view import Viewer, draw, in_use
from tactile_cdma.views.terminal import Look, Numbers
from test.support.skin_client import node_with
from test.support.spinning import living
from torture.load.hostile import lie, of_now

TAXELS = 16
HEADER = Header(frame_id="skin")
ARRAY = TactileArray(
    header=HEADER, height=4, width=4, pressure=array("f", range(16)), status=array("B", bytes(16))
)
CONTACTS = TactileContacts(
    header=HEADER,
    contacts=[TactileContact(patch="/skin", force=Vector3(z=-1.0), taxels=array("H", [1]))],
    touched=True,
    taxels_in_service=TAXELS,
    taxels_valid=TAXELS,
)
DIAGNOSTICS = DiagnosticArray(
    status=[DiagnosticStatus(name="skin: stream", message="no frames", level=b"\2")]
)
POSES = TFMessage(transforms=[TransformStamped(header=HEADER, child_frame_id="palm")])
RECEIVED = {"source_timestamp": 1, "received_timestamp": 2}
COLOURS = re.compile(r"\x1b\[(?:[\d;]*m|H|J|K)")


def info(height: int = 4) -> TactileSkinInfo:
    """Of the same skin; height 1: an irregular one."""
    return TactileSkinInfo(
        header=HEADER,
        height=height,
        width=TAXELS // height,
        positions=[Point32(x=0.01 * (i % 4), y=0.01 * (i // 4)) for i in range(TAXELS)],
        normals=[Point32(z=1.0)] * TAXELS,
        area=array("f", [1e-4] * TAXELS),
        node=array("H", range(1, TAXELS + 1)),
    )


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    with living(Viewer("/skin/tactile")) as viewer:
        yield viewer


def told_lies(taken: list[tuple[Callable[[Any], object], Any]], times: int) -> Iterator[bool]:
    """Have lies and some truth taken; yields after each whether it was refused."""
    rng = Random(1)
    for _ in range(times):
        take, message = rng.choice(taken)
        try:
            take(of_now(lie(message, rng) if rng.random() < 0.8 else message))
            yield False
        except TactileError:  # which the executor survives and logs
            yield True


def test_the_terminal_viewer_draws_on_and_no_message_writes_to_the_terminal(viewer: Viewer) -> None:
    size, refused = os.terminal_size((60, 20)), 0
    looks = Look(1e5), Look(1e5, Numbers.NODES, coloured=False, unicode=False)
    receive = partial(viewer._receive, about={})
    taken = [(receive, ARRAY), (viewer._inform, info()), (viewer._inform, info(1))]
    for is_refused in told_lies([*taken, (viewer.complaints.take, DIAGNOSTICS)], 200):
        refused += is_refused
        for look in looks:
            if viewer.latest is not None:
                text = draw(viewer, look, of_force=bool(refused % 2), size=size)
                assert COLOURS.sub("", text).replace("\n", "").isprintable()
                assert in_use(viewer.latest).size <= len(viewer.latest.pressure)
    assert 20 < refused < 150
    viewer._receive(of_now(ARRAY), {})
    assert viewer.latest is ARRAY, "the truth is taken after all lies"


@pytest.mark.parametrize(
    "fields",
    [
        {"pressure": [], "status": [], "height": 0},
        {"pressure": [1.0] * 15},
        {"status": [0] * 17},
        {"height": 5},
        {"pressure": [float("inf")] * 16},
        {"device_time_us": 2**64 - 1},
    ],
)
def test_arrays_that_contradict_themselves_are_refused(
    viewer: Viewer, fields: dict[str, Any]
) -> None:
    message = lie(ARRAY, Random(0))
    for name in ARRAY.get_fields_and_field_types():
        setattr(message, name, fields.get(name, getattr(ARRAY, name)))
    with pytest.raises(MessageError):
        viewer._receive(message, {})
    assert viewer.latest is None


def test_a_body_is_told_in_a_line_whatever_it_says() -> None:
    viewer = BodyViewer("/body")
    for _ in told_lies([(viewer._take, CONTACTS), (viewer.complaints.take, DIAGNOSTICS)], 300):
        assert line(viewer.latest, 1.0, viewer.complaints.worst)
    nowhere = TactileContact(patch="/a\x1b]0;x\x07/skin", position=Point(x=float("inf"), y=-1e-4))
    said = line(TactileContacts(contacts=[nowhere], touched=True), 1.0, "")
    assert "a\x1b]0;x\x07 0.0 N (inf 0 0 mm)" in said, "which say() escapes"
    viewer.destroy_node()


def test_a_body_goes_on_and_never_claims_touched_and_untouched() -> None:
    body = node_with(BodyNode, patches=["palm/skin"])
    contacts, taxels, points = body.outputs
    name = "/palm/skin"

    def taking(take: Callable[..., object]) -> Callable[[Any], object]:
        return lambda message: take(name, serialize_message(message), RECEIVED)

    taken: list[tuple[Callable[[Any], object], Any]] = [
        (taking(contacts.take), CONTACTS),
        (taking(taxels.take), ARRAY),
        (taking(points._take), ARRAY),
        (lambda message: taxels.take_info(name, message), info()),
        (lambda message: points.take_info(name, message), info()),
        (body.patches._transforms._take, POSES),
    ]
    for _ in told_lies(taken, 300):
        for output in (contacts, taxels):
            output.publish({name}, 0.0)
        points._become_due()
        points._publish_names()
        body._report()
        if latest := contacts.latest.get(name):
            assert not (latest.untouched and latest.touched)
    body.destroy_node()


def test_a_client_tells_what_it_refuses_and_keeps_no_places_that_contradict_it() -> None:
    """Its callbacks are called by the program's executor, which anything raised would end."""
    node = rclpy.create_node("program")
    skin = SkinClient(node, frames=True)
    taken: list[tuple[Callable[[Any], None], Any]] = [
        (lambda message: skin._take_contacts(serialize_message(message), {}), CONTACTS),
        (skin._take_info, info()),
        (skin._take_array, ARRAY),
    ]
    refused = 0
    for is_raised in told_lies(taken, 300):
        assert not is_raised
        refused += bool(skin._fault)
        assert skin.touch.problem.isprintable()
        if frame := skin.frame:
            sizes = map(len, (frame.pressure_pa, frame.positions_m, frame.normals, frame.areas_m2))
            assert len(set(sizes)) == 1
    assert refused > 50
    node.destroy_node()


@pytest.mark.parametrize(
    "fields",
    [
        {"touched": False},
        {"contacts": []},
        {"untouched": True},
        {"untouched": True, "touched": False, "contacts": [], "taxels_valid": 15},
        {"taxels_valid": 17},
    ],
)
def test_contacts_that_contradict_themselves_are_refused(fields: dict[str, Any]) -> None:
    names = CONTACTS.get_fields_and_field_types()
    values = {name: getattr(CONTACTS, name) for name in names} | fields
    with pytest.raises(MessageError, match="and claims"):
        Touches.read(serialize_message(TactileContacts(**values)))
