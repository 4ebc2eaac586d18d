# SPDX-License-Identifier: Apache-2.0

"""The names of a body's patches as markers."""

import numpy as np
import pytest
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from tactile_cdma.ros.body.names import ABOVE_LETTERS, LETTER_SHARE, body_names

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
