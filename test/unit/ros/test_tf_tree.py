# SPDX-License-Identifier: Apache-2.0

"""The tree of tf frames: poses along every path."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import TransformError
from tactile_cdma.places import poses as tf_tree
from tactile_cdma.places.poses import Pose, TfTree

triples = st.tuples(*[st.floats(-4, 4)] * 3)
poses = st.builds(Pose.of_rpy, triples, triples)
SHIFT = Pose.of_rpy((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def assert_same(one: Pose, other: Pose) -> None:
    np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-9)
    np.testing.assert_allclose(one.translation_m, other.translation_m, atol=1e-9)


@given(st.lists(st.tuples(st.integers(0, 100), poses), min_size=1, max_size=12), st.data())
def test_every_way_through_a_tree_composes(
    steps: list[tuple[int, Pose]], data: st.DataObject
) -> None:
    """Each frame has a random earlier parent; the reference is each frame's pose in the first."""
    tree, in_root = TfTree(), [Pose.of_rpy((0, 0, 0), (0, 0, 0))]
    for child, (parent, pose) in enumerate(steps, start=1):
        parent %= child
        tree.put(f"f{parent}", f"f{child}", pose)
        in_root.append(in_root[parent] @ pose)
    pick = st.integers(0, len(steps))
    a, b = data.draw(pick), data.draw(pick)
    assert_same(tree.pose(f"f{a}", f"f{b}"), in_root[a].inverse @ in_root[b])


def test_the_latest_counts_also_below_another_parent() -> None:
    tree = TfTree()
    tree.put("body", "arm", SHIFT)
    tree.put("arm", "palm", SHIFT)
    tree.put("/body", "/arm", SHIFT @ SHIFT)
    assert tree.pose("body", "palm").translation_m[0] == 3.0
    tree.put("body", "palm", SHIFT)
    assert tree.pose("body", "palm").translation_m[0] == 1.0


def test_a_frame_in_itself_needs_no_transforms() -> None:
    assert_same(TfTree().pose("palm", "palm"), Pose(np.eye(3), np.zeros(3)))


def test_frames_that_nothing_connects_are_named() -> None:
    tree = TfTree()
    tree.put("odom", "body", SHIFT)
    tree.put("hand", "palm", SHIFT)
    with pytest.raises(
        TransformError, match="from 'palm' to 'body': 'palm' hangs from 'hand', 'body' from 'odom'"
    ):
        tree.pose("body", "palm")


def test_cycles_are_named_and_can_be_mended() -> None:
    tree = TfTree()
    tree.put("a", "b", SHIFT)
    tree.put("b", "c", SHIFT)
    tree.put("c", "a", SHIFT)
    with pytest.raises(TransformError, match="cycle: c → b → a"):
        tree.pose("c", "b")
    with pytest.raises(TransformError, match="'a' is given as its own parent"):
        tree.put("a", "a", SHIFT)
    tree.put("map", "a", SHIFT)
    assert tree.pose("map", "c").translation_m[0] == 3.0


def test_names_without_end_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tf_tree, "MOST_FRAMES", 3)
    tree = TfTree()
    for child in "abc":
        tree.put("body", child, SHIFT)
    with pytest.raises(TransformError, match="more than 3 tf frames"):
        tree.put("body", "d", SHIFT)
    tree.put("body", "a", SHIFT @ SHIFT)
    assert tree.pose("body", "a").translation_m[0] == 2.0
