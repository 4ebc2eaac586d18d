# SPDX-License-Identifier: Apache-2.0

"""Markers of a skin and of its contacts, from frame to frame."""

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from tactile_cdma.messages.cdr import Heading
from tactile_cdma.places.layout import MOST_SQUARES, Layout
from tactile_cdma.places.layout_shapes import cylinder
from tactile_cdma.readings.contact import ContactThresholds, ContactTracker
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.ros.body.messages import ABOVE_LETTERS, LETTER_SHARE, body_names
from tactile_cdma.ros.common.convert import header
from tactile_cdma.ros.driver.markers import (
    ARROWS,
    BLIND,
    RESULTANT,
    SQUARE_SHARE,
    SUM,
    SUNK_PITCHES,
    SURFACE,
    TEXTS,
    UNREAD_SHARE,
    SkinMarkers,
)
from tactile_cdma.views.heatmap import NO_READING_RGB, colours
from test.support.skin_client import xyz

PITCH_M, MAX_PA, HEADING = 7e-3, 140e3, Heading(0, "cuff")
NODES = np.array([*range(1, 24), 0], dtype=np.int32)
CUFF = Layout(
    **vars(cylinder(4, 6, PITCH_M, 20e-3)),
    name="cuff",
    rows=4,
    columns=6,
    nodes=NODES,
    pitch_m=PITCH_M,
)


class Skin:
    """Draws one frame after the other."""

    def __init__(self, layout: Layout = CUFF) -> None:
        self.layout, self.markers = layout, SkinMarkers(layout)
        self.tracker, self.t_s = ContactTracker(layout, ContactThresholds(1e3, 5e2)), 0.0

    def draw(self, pressed_pa: dict[int, float], every: Status = Status.OK) -> MarkerArray:
        """pressed_pa: by taxel; all else reads 0. every: status of those in service."""
        pressure_pa = np.zeros(len(self.layout), dtype=np.float32)
        pressure_pa[list(pressed_pa)] = list(pressed_pa.values())
        status = np.full(len(self.layout), every, dtype=np.uint8)
        status[self.layout.nodes == 0] = Status.MASKED
        self.t_s += 0.02
        contacts = self.tracker.update(Readings(pressure_pa, pressure_pa, status), self.t_s)
        drawn = self.markers.markers(pressure_pa, MAX_PA, contacts, HEADING, lifetime_s=1.5)
        return deserialize_message(drawn, MarkerArray)


def of(array: MarkerArray, namespace: str, action: int = Marker.ADD) -> list[Marker]:
    return [m for m in array.markers if (m.ns, m.action) == (namespace, action)]


def test_the_surface_has_a_coloured_square_for_every_taxel_with_a_node() -> None:
    pressed = {0: 20e3, 7: 139e3, 8: float("nan")}
    [surface] = of(Skin().draw(pressed), SURFACE)
    assert surface.type == Marker.TRIANGLE_LIST
    assert surface.header == header(HEADING)
    assert xyz(surface.scale).tolist() == [1, 1, 1]
    corners = np.array([xyz(point) for point in surface.points]).reshape(-1, 6, 3)
    # Below the taxels' places, with gaps between them, and smaller where there is no reading.
    middles = corners[:, [0, 1, 2, 5]].mean(axis=1)
    depth_m = SUNK_PITCHES * PITCH_M
    assert np.allclose(CUFF.positions_m[:23] - depth_m * CUFF.normals[:23], middles, atol=1e-7)
    full = CUFF.squares_m[:23]
    shares = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    shares /= np.linalg.norm(full[:, 1] - full[:, 0], axis=1)
    assert np.allclose(shares, np.where(np.arange(23) == 8, UNREAD_SHARE, SQUARE_SHARE))
    assert UNREAD_SHARE < SQUARE_SHARE < 1
    found = np.array([(c.r, c.g, c.b, c.a) for c in surface.colors]).reshape(23, 6, 4)
    pressure_pa = np.zeros(23, dtype=np.float32)
    pressure_pa[list(pressed)] = list(pressed.values())
    wanted = np.column_stack([colours(pressure_pa, MAX_PA) / 255, np.ones(23)])
    assert np.allclose(found, wanted[:, None], atol=1e-6)
    assert np.allclose(found[8, 0, :3] * 255, NO_READING_RGB)


def test_an_arrow_ends_at_the_centre_of_pressure_and_says_the_force() -> None:
    pressure_pa = 40e3
    drawn = Skin().draw({8: pressure_pa})
    [arrow], [text] = of(drawn, ARROWS), of(drawn, TEXTS)
    tail, head = (xyz(point) for point in arrow.points)
    force_n = pressure_pa * PITCH_M**2
    assert np.allclose(head, CUFF.positions_m[8], atol=1e-7)
    # The force points into the skin, so the arrow comes from outside; a square of its length bears
    # the force at the top of the scale.
    assert np.allclose(tail - head, CUFF.normals[8] * (force_n / MAX_PA) ** 0.5, atol=1e-6)
    assert text.text == f"{force_n:.3g}N"
    beyond_m = (xyz(text.pose.position) - tail) @ CUFF.normals[8]
    assert beyond_m == pytest.approx(text.scale.z)
    assert (arrow.lifetime.sec, arrow.lifetime.nanosec) == (1, 500_000_000)


def test_of_a_saturated_contact_the_force_is_at_least_that() -> None:
    [text] = of(Skin().draw({8: 140e3}, every=Status.SATURATED), TEXTS)
    assert text.text.startswith(">")


def test_beside_a_taxel_without_a_reading_the_force_is_at_least_that() -> None:
    nan = float("nan")
    [beside] = of(Skin().draw({8: 40e3, 9: nan}), TEXTS)
    [apart] = of(Skin().draw({8: 40e3, 11: nan}), TEXTS)
    assert (beside.text.startswith(">"), apart.text.startswith(">")) == (True, False)


def test_a_skin_that_is_not_read_says_so_where_an_untouched_one_shows_nothing() -> None:
    skin = Skin()
    every = {taxel: float("nan") for taxel in range(24)}
    assert not of(skin.draw({}), BLIND)
    [text] = of(skin.draw(every), BLIND)
    assert text.text == "unread:23/23"
    [text] = of(skin.draw({3: float("nan")}), BLIND)
    assert text.text == "unread:1/23"
    [text] = of(skin.draw({3: float("nan")}, every=Status.LOW_SNR), BLIND)
    assert text.text == "unread:23/23"
    assert [m.id for m in of(skin.draw({}), BLIND, Marker.DELETE)] == [text.id]
    assert not of(skin.draw({}), BLIND, Marker.DELETE)


def test_markers_of_contacts_that_are_gone_are_deleted_once_and_others_keep_their_ids() -> None:
    skin = Skin()
    first = skin.draw({0: 40e3, 22: 30e3})
    ids = [arrow.id for arrow in of(first, ARROWS)]
    assert len(set(ids)) == 2
    assert [text.id for text in of(first, TEXTS)] == ids
    second = skin.draw({22: 30e3})
    assert [arrow.id for arrow in of(second, ARROWS)] == [ids[1]]
    for namespace in (ARROWS, TEXTS):
        assert [m.id for m in of(second, namespace, Marker.DELETE)] == [ids[0]]
    third = skin.draw({22: 30e3})
    assert not [m for m in third.markers if m.action == Marker.DELETE]


def test_no_arrow_is_longer_than_the_skin_is_wide() -> None:
    flat = Layout.grid(16, 0, 0, PITCH_M, PITCH_M)
    [arrow] = of(Skin(flat).draw(dict.fromkeys(range(16), MAX_PA)), ARROWS)
    tail, head = (xyz(point) for point in arrow.points)
    assert np.linalg.norm(tail - head) == pytest.approx(4 * PITCH_M)


def test_the_resultant_of_several_contacts_is_their_sum_at_the_centre_of_pressure() -> None:
    skin = Skin()
    assert not of(skin.draw({0: 40e3}), RESULTANT), "one contact is its own resultant"
    drawn = skin.draw({0: 40e3, 22: 30e3})
    [arrow], [text] = of(drawn, RESULTANT), of(drawn, SUM)
    forces_n = -CUFF.normals[[0, 22]] * PITCH_M**2 * [[40e3], [30e3]]
    assert text.text == f"sum={np.linalg.norm(forces_n.sum(axis=0)):.3g}N"
    centre_m = (4 * CUFF.positions_m[0] + 3 * CUFF.positions_m[22]) / 7
    assert np.allclose(xyz(arrow.points[1]), centre_m, atol=1e-6)
    gone = skin.draw({0: 40e3})
    assert [m.id for name in (RESULTANT, SUM) for m in of(gone, name, Marker.DELETE)] == [0, 0]


def test_no_text_has_a_space_for_rviz_would_tear_it_apart() -> None:
    nan = float("nan")
    drawn = Skin().draw({0: 40e3, 9: nan, 22: 30e3, 12: -2e3})  # below its zero: doubtful
    texts = [m.text for m in drawn.markers if m.type == Marker.TEXT_VIEW_FACING]
    assert len(texts) == 4 and not any(" " in text for text in texts)


def test_large_skins_have_contacts_only() -> None:
    largest = Layout.grid(MOST_SQUARES, 0, 0, PITCH_M, PITCH_M)
    larger = Layout.grid(MOST_SQUARES + 16, 0, 16, PITCH_M, PITCH_M)
    assert of(Skin(larger).draw({0: float("nan")}), BLIND), "without squares that turn grey"
    assert of(Skin(largest).draw({0: 40e3}), SURFACE)
    drawn = Skin(larger).draw({0: 40e3})
    assert not of(drawn, SURFACE)
    assert len(of(drawn, ARROWS)) == len(of(drawn, TEXTS)) == 1


PALM_M = np.array([[0.0, 0.0, 0.1], [0.2, 0.1, 0.3]])
BACK_M = np.array([[-0.4, 0.5, 0.0], [-0.2, 0.5, 0.2], [-0.3, 0.5, 0.1]])


def test_a_name_is_above_the_top_of_its_patch_and_in_scale_with_the_body() -> None:
    palm, back = body_names({"/left_palm/skin": PALM_M, "/back/skin": BACK_M}, "body").markers
    letter_m = LETTER_SHARE * np.linalg.norm([0.6, 0.5, 0.3])
    for marker, text, (x, y, top_m) in (
        (palm, "left_palm", (0.1, 0.05, 0.3)),
        (back, "back", (-0.3, 0.5, 0.2)),
    ):
        assert (marker.text, marker.ns, marker.id) == (text, text, 0)
        assert (marker.type, marker.action) == (Marker.TEXT_VIEW_FACING, Marker.ADD)
        assert marker.header == Header(frame_id="body")
        at = marker.pose.position
        above_m = ABOVE_LETTERS * letter_m
        assert [at.x, at.y, at.z] == pytest.approx([x, y, top_m + above_m])
        assert above_m > letter_m / 2, "a text's place is its middle"
        assert marker.scale.z == pytest.approx(letter_m)
        assert marker.color.a == 1.0
        assert marker.lifetime.sec > 0, "names of a node that ended go"


def test_a_driver_of_another_name_has_all_of_it() -> None:
    markers = body_names({"/hand/left/tip": PALM_M, "/skin": BACK_M}, "body").markers
    assert [marker.text for marker in markers] == ["hand/left/tip", "skin"]
