# SPDX-License-Identifier: Apache-2.0

"""Times of recording that cannot be: their messages are left out, and nothing else changes."""

import random
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.datasets.sources.bag_file import FAR_NS, believed_span
from tactile_cdma.datasets.sources.bag_source import BagSource
from tactile_cdma.datasets.sources.opening import Wanted
from test.support.bags import BEGIN_NS, BagMaker
from test.support.command_line import Printed

pytestmark = pytest.mark.xdist_group("datasets")
SECONDS = 1.0
FRAMES = 78
STRAY = 40
"""Sequence of the frame whose time of recording is damaged."""
TIMES_NS = [1, BEGIN_NS + 2 * FAR_NS]


def written(path: Path, time_ns: int, sqlite: bool) -> Path:
    """A bag with a damaged time, of which its metadata tell as well."""
    maker = BagMaker().skin("/skin", SECONDS).joints("/joint_states", SECONDS)
    for i, (_, topic, kind, message) in enumerate(maker.messages):
        if topic == "/skin/tactile" and message.sequence == STRAY:
            maker.messages[i] = (time_ns, topic, kind, message)
    return maker.write(path, sqlite)


def damaged_later(path: Path, time_ns: int) -> Path:
    """A bag with right metadata, and a damaged time in its file."""
    maker = BagMaker().skin("/skin", SECONDS).joints("/joint_states", SECONDS)
    seen_ns = next(
        seen
        for seen, topic, _, one in maker.messages
        if topic[-7:] == "tactile" and one.sequence == STRAY
    )
    maker.write(path, sqlite=True)
    with sqlite3.connect(path / f"{path.name}.db3") as base:
        changed = base.execute(
            "UPDATE messages SET timestamp = ? WHERE timestamp = ?", (time_ns, seen_ns)
        )
        assert changed.rowcount == 1
    base.close()
    return path


BAGS: dict[str, Callable[[Path, int], Path]] = {
    "mcap": lambda path, time_ns: written(path, time_ns, sqlite=False),
    "sqlite": lambda path, time_ns: written(path, time_ns, sqlite=True),
    "damaged later": damaged_later,
}


@pytest.mark.parametrize("time_ns", TIMES_NS)
@pytest.mark.parametrize("kind", BAGS)
def test_one_damaged_time_costs_one_message(
    tmp_path: Path, printed: Printed, kind: str, time_ns: int
) -> None:
    bag = BAGS[kind](tmp_path / "bag", time_ns)
    note = f"/skin/tactile: 1 of {FRAMES} messages were recorded more than 24 h before or after"
    lines = printed("info", bag).out.splitlines()
    assert lines[0].startswith("bag: 1.00")
    [rate] = [line for line in lines if line.startswith("frames: ")]
    assert rate.startswith(f"frames: {FRAMES - 1} in 0.986 s")
    assert any(line.startswith(f"note: {note}") for line in lines)

    table = tmp_path / "out.npz"
    printed("export", bag, "-o", table, "--start", 0, "--end", 0.7)
    with np.load(table) as found:
        assert STRAY not in found["sequence"] and 50 < len(found["sequence"]) < 56
        assert (np.diff(found["wall_time_s"]) > 0).all()

    parquet = pytest.importorskip("pyarrow.parquet")
    out = ["--lerobot", tmp_path / "out", "--fps", 30, "--state", "/joint_states"]
    assert f"tactile-cdma: {bag}: {note}" in printed("export", bag, *out).err
    rows = parquet.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    assert 28 <= len(rows) <= 30


def test_what_is_left_out_is_counted_anew_in_every_reading(tmp_path: Path) -> None:
    source = BagSource(written(tmp_path / "bag", 1, sqlite=False), Wanted())
    for _ in range(2):
        assert sum(1 for _ in source.samples(None, None)) == FRAMES - 1
        [note] = source.notes
        assert note.startswith(f"/skin/tactile: 1 of {FRAMES} messages")


def test_damaged_times_of_marks_are_not_believed(tmp_path: Path, printed: Printed) -> None:
    maker = BagMaker().skin("/skin", SECONDS)
    for seen_s, begins in ((0.2, True), (0.6, False)):
        maker.add(seen_s, "/marks", "std_msgs/msg/Bool", data=begins)
    time_ns, *rest = maker.messages[-1]
    maker.messages.append((time_ns + 2 * FAR_NS, *rest))
    bag, table = maker.write(tmp_path / "bag"), tmp_path / "out.npz"
    said = printed("export", bag, "-o", table, "--marks", "/marks").err
    assert "/marks: 1 of 3 messages were recorded more than 24 h" in said
    with np.load(table) as found:
        assert set(found["episode"]) == {0} and 30 < len(found["episode"]) < 33


def test_a_bag_of_many_days_is_believed() -> None:
    times_ns = range(BEGIN_NS, BEGIN_NS + 10 * FAR_NS, FAR_NS // 2)
    assert believed_span(times_ns) == (times_ns[0], times_ns[-1])
    assert believed_span([BEGIN_NS]) == (BEGIN_NS, BEGIN_NS)


@given(
    st.lists(st.integers(0, FAR_NS), min_size=2, max_size=9),
    st.sets(st.sampled_from([-9, -6, -3, 3, 6, 9])),
    st.randoms(),
)
def test_most_times_are_believed_in_any_order(
    together_ns: list[int], strays: set[int], order: random.Random
) -> None:
    """As in a bag of several files. The strays are far from these, and one from the other."""
    times_ns = [BEGIN_NS + t for t in (*together_ns, *(FAR_NS * stray for stray in strays))]
    order.shuffle(times_ns)
    span = BEGIN_NS + min(together_ns), BEGIN_NS + max(together_ns)
    assert believed_span(times_ns) == span
