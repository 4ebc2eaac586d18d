# SPDX-License-Identifier: Apache-2.0

"""Bags as people have them: several publishers, foreign channels, split files, compression."""

import json
import random
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.datasets.lerobot import export
from tactile_cdma.datasets.sources.bag_file import FAR_NS, believed_span
from tactile_cdma.datasets.sources.bag_source import BagSource
from tactile_cdma.datasets.sources.opening import Wanted
from test.support.bags import BEGIN_NS, TAXELS, BagMaker
from test.support.command_line import Printed, Refused

parquet = pytest.importorskip("pyarrow.parquet")
pytestmark = pytest.mark.xdist_group("datasets")


DATASET = "--fps", 30, "--lerobot"
JOINTS = "sensor_msgs/msg/JointState"


def rows(folder: Path) -> Any:
    """Of a dataset, by column."""
    return parquet.read_table(folder / "data").to_pydict()


def names(folder: Path, column: str) -> list[str]:
    features = json.loads((folder / "meta/info.json").read_text())["features"]
    return features[column]["names"]  # type: ignore[no-any-return]


def robot(maker: BagMaker, seconds: float, gripper_end_s: float) -> None:
    """An arm at 100 Hz and a gripper at 20 Hz, by two programs on one topic."""
    arm = {"elbow": lambda t_s: t_s, "wrist": lambda t_s: -t_s}
    maker.joints("/joint_states", seconds, **arm)
    maker.joints("/joint_states", gripper_end_s, 20, finger=lambda t_s: 10 + t_s)


def test_two_publishers_of_joints_are_one_state_or_chosen(tmp_path: Path, printed: Printed) -> None:
    maker = BagMaker().skin("/skin", 2.0)
    robot(maker, 2.0, 2.0)
    bag = maker.write(tmp_path / "bag")
    words, joints = ("export", bag, *DATASET), "/joint_states"
    said = printed(*words, tmp_path / "all", "--state", joints, "--action", joints).err
    found = rows(tmp_path / "all")
    state = np.array(found["observation.state"])
    assert (state == np.array(found["action"])).all() and len(state) > 50
    order = names(tmp_path / "all", "observation.state")
    elbow, wrist, finger = (state[:, order.index(name)] for name in ("elbow", "wrist", "finger"))
    t_s = (np.array(found["unix_time_ns"]) - BEGIN_NS) * 1e-9
    assert (wrist == -elbow).all() and (np.abs(elbow - t_s) < 0.011).all()
    assert ((t_s - (finger - 10) >= -1e-6) & (t_s - (finger - 10) < 0.051)).all()

    said += printed(*words, tmp_path / "some", "--state", f"{joints}:finger,wrist").err
    some = rows(tmp_path / "some")
    assert sorted(names(tmp_path / "some", "observation.state")) == ["finger", "wrist"]
    assert np.array(some["observation.state"]).shape == (len(state), 2)
    assert not said


def test_one_of_two_publishers_that_stops_is_told(tmp_path: Path, printed: Printed) -> None:
    """The arm goes on: the gripper's last position must not be taken for the present one."""
    maker = BagMaker().skin("/skin", 3.0)
    robot(maker, 3.0, 1.0)
    words = maker.write(tmp_path / "bag"), *DATASET, tmp_path / "out", "--state", "/joint_states"
    assert "(/joint_states) had stopped, first at 0.9" in printed("export", *words).err
    t_s = (np.array(rows(tmp_path / "out")["unix_time_ns"]) - BEGIN_NS) * 1e-9
    assert 1.3 < t_s[-1] < 1.55


@pytest.mark.parametrize("arm_first", [False, True])
def test_files_agree_on_joints_by_name(tmp_path: Path, printed: Printed, arm_first: bool) -> None:
    """Whoever publishes first, and in whatever order: a column is one joint in all files."""
    bags = []
    for file in range(2):
        maker = BagMaker().skin("/skin", 1.0)
        robot(maker, 1.0, 1.0)
        if bool(file) == arm_first:
            first_of_each = [0, 100]
            for message in maker.without("/joint_states", *first_of_each).of("/joint_states"):
                message.name, message.position = message.name[::-1], message.position[::-1].copy()
        bags.append(maker.write(tmp_path / f"bag_{file}"))
    printed("export", *bags, *DATASET, tmp_path / "out", "--state", "/joint_states")
    found = rows(tmp_path / "out")
    state = np.array(found["observation.state"])
    order = names(tmp_path / "out", "observation.state")
    elbow, wrist, finger = (state[:, order.index(name)] for name in ("elbow", "wrist", "finger"))
    assert set(found["episode_index"]) == {0, 1}
    assert (wrist == -elbow).all() and elbow.min() >= 0 and finger.min() >= 10


def test_two_topics_with_the_same_elements_are_refused(
    tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    maker = BagMaker().skin("/skin", 0.5).joints("/left", 0.5).joints("/right", 0.5)
    bag = maker.write(tmp_path / "bag")
    words = "export", bag, *DATASET, tmp_path / "out"
    said = refused(*words, "--state", "/left", "--state", "/right")
    assert "state: /right has finger, wrist, as another topic does" in said
    printed(*words, "--state", "/left:finger", "--state", "/right:wrist")
    assert names(tmp_path / "out", "observation.state") == ["finger", "wrist"]


def with_channels(bag: Path, *channels: tuple[str, str, str, str, str]) -> Path:
    """A bag's MCAP with more channels, of one message each, and without the index.

    channels: topic, type, encoding of its schema, the schema, encoding of its messages.
    """
    [path] = bag.glob("*.mcap")
    raw, added = path.read_bytes(), b""

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    def record(kind: int, body: bytes) -> bytes:
        return bytes([kind]) + struct.pack("<Q", len(body)) + body

    for number, (topic, kind, encoding, schema, messages) in enumerate(channels, start=900):
        one = struct.pack("<H", number)
        added += record(3, one + text(kind) + text(encoding) + text(schema))
        added += record(4, one + one + text(topic) + text(messages) + text(""))
        stamps = struct.pack("<IQQ", 0, BEGIN_NS, BEGIN_NS)
        added += record(5, one + stamps + b"\x00\x01\x00\x00odd")
    begin = 8 + 9 + struct.unpack("<Q", raw[9:17])[0]  # behind the magic and the header
    end = struct.unpack("<Q", raw[-28:-20])[0]  # where the summary begins, by the footer
    (other := bag.parent / "other.mcap").write_bytes(
        raw[:begin] + added + raw[begin:end] + record(2, bytes(20)) + raw[:8]
    )
    return other


def test_channels_that_cannot_be_read_are_left_out_by_name(
    tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    maker = BagMaker().skin("/skin", 1.0).camera("/front/image_raw", 1.0, 30)
    event = "example_interfaces/srv/AddTwoInts_Event"
    bag = with_channels(
        maker.write(tmp_path / "bag"),
        ("/boxes", "foxglove.SceneUpdate", "protobuf", "\x00\x01", "protobuf"),
        ("/log", "log", "jsonschema", "{}", "json"),
        ("/add/_service_event", event, "ros2msg", f"{event}[<=1] of nothing known", "cdr"),
        ("/wrist/image", "sensor_msgs/msg/Image", "ros2msg", "@ no definition", "cdr"),
        ("/skin/contacts", "tactile_cdma/msg/TactileContacts", "ros2msg", "Nothing here", "cdr"),
        ("/top/image", "sensor_msgs/msg/Image", "", "", "cdr"),
    )
    said = printed("export", bag, *DATASET, tmp_path / "out").err
    found = rows(tmp_path / "out")
    assert len(found["observation.images.front"]) > 25
    assert {name.split(".")[1] for name in found if "." in name} == {"tactile", "images"}
    for topic, reason in (
        ("/boxes", "encoded as protobuf"),
        ("/log", "encoded as json"),
        ("/wrist/image", "the definition of sensor_msgs/msg/Image"),
        ("/skin/contacts", "none of its 1 messages can be read: they do not fit their definition"),
        ("/top/image", "none of its 1 messages can be read: they do not fit their definition"),
    ):
        assert f"{topic} is left out: {reason}" in said
    assert "/boxes: foxglove.SceneUpdate, 1 message" in printed("info", bag).out
    words = "export", bag, *DATASET, tmp_path / "none"
    assert "/wrist/image: the definition" in refused(*words, "--image", "/wrist/image")
    assert "/log is log; state takes" in refused(*words, "--state", "/log")
    unread = refused(*words, "--image", "/top/image")
    assert "/top/image: none of its 1 messages can be read: they do not fit" in unread


SERIALISED = {
    (1.5,): "000100000000000000000000010000000073d01b01000000020000007800000001000000"
    "000000000000f83f0000000000000000107f000018415520",
    (1.5, -2.5): "0001000000000000000000000100000000208400020000000200000078000000"
    "020000007900a60202000000000000000000f83f00000000000004c0"
    "00000000000000000000660353000000",
}
"""JointStates with positions only, as rclpy.serialization of ROS 2 Jazzy makes them: it reserves
room for numbers of the empty lists to begin at, and what lay there follows the message."""


def test_joints_are_read_as_rclpy_s_own_serialisation_pads_them(
    tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    """Positions of one joint and of two; more bytes than the padding are a damaged message."""
    for places, told in SERIALISED.items():
        maker = BagMaker().skin("/skin", 1.0)
        raw = bytes.fromhex(told)
        for i in range(50):
            maker.messages.append((BEGIN_NS + i * 20_000_000, "/joints", JOINTS, raw))
        words = "export", maker.write(tmp_path / f"bag{len(places)}"), *DATASET
        said = printed(*words, tmp_path / f"out{len(places)}", "--state", "/joints").err
        found = np.array(rows(tmp_path / f"out{len(places)}")["observation.state"])
        assert len(found) > 20 and (found.reshape(len(found), -1) == places).all()
        assert "left out" not in said
    spoilt = [(at, topic, kind, raw + bytes(4)) for at, topic, kind, raw in maker.messages[-50:]]
    maker.messages[-50:] = spoilt
    words = "export", maker.write(tmp_path / "longer"), *DATASET
    said = refused(*words, tmp_path / "none", "--state", "/joints")
    assert "/joints: none of its 50 messages can be read: they do not fit their definition" in said


def test_messages_that_do_not_fit_are_counted(tmp_path: Path, printed: Printed) -> None:
    maker = BagMaker().skin("/skin", 1.0).spoilt("/skin/tactile", 5, 6, 7)
    output = printed("export", maker.write(tmp_path / "bag"), "-o", tmp_path / "out.npz")
    assert "frames=75 missing_frames=3 " in output.out
    assert "/skin/tactile: 3 of 78 messages do not fit their definition" in output.err


def test_the_info_of_a_split_bag_is_in_its_first_file(tmp_path: Path, printed: Printed) -> None:
    first, later = (BagMaker().skin("/skin", 0.5) for _ in range(2))
    later.without("/skin/info")
    folder = tmp_path / "session"
    folder.mkdir()
    for number, maker in enumerate((first, later)):
        [file] = maker.write(tmp_path / f"file_{number}").glob("*.mcap")
        file.rename(folder / f"session_{number}.mcap")
    second = folder / "session_1.mcap"
    moved = tmp_path / "later.mcap"
    moved.write_bytes(second.read_bytes())
    out = tmp_path / "out.npz"
    for words, known in (
        ([second], True),
        ([moved], False),
        ([moved, "--info", folder / "session_0.mcap"], True),
        ([moved, "--info", moved], False),
    ):
        said = printed("export", *words, "-o", out, "--force").err
        assert ("/skin/info is that of" in said) == known
        assert ("no info, so places" in said) != known
        with np.load(out) as found:
            assert np.isfinite(found["position_m"]).all() == known


@pytest.mark.parametrize("compressed", ["file", "message"])
@pytest.mark.parametrize("sqlite", [False, True], ids=["mcap", "sqlite"])
def test_compressed_bags_are_read(
    tmp_path: Path, printed: Printed, sqlite: bool, compressed: str
) -> None:
    bag = BagMaker().skin("/skin", 0.5).write(tmp_path / "bag", sqlite, compressed)
    said = printed("export", bag, "-o", tmp_path / "out.npz").out
    assert f"frames=39 missing_frames=0 taxels={TAXELS} " in said


def test_a_compressed_file_by_itself_is_told(tmp_path: Path, refused: Refused) -> None:
    [file] = BagMaker().skin("/skin", 0.1).write(tmp_path / "bag", compressed="file").glob("*.zstd")
    said = refused("export", file, "-o", tmp_path / "out.npz")
    assert f"{file}: a compressed file of a bag: give its folder, or decompress it" in said


def test_long_sessions_keep_lerobot_s_tolerance(
    tmp_path: Path, printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps of float32 timestamps within an episode differ from 1 / fps by less than 100 µs."""
    steps_s = np.diff(np.arange(export.LONGEST_S * 30).astype(np.float32) / np.float32(30))
    assert np.abs(steps_s - 1 / 30).max() < 1e-4
    later_s = np.diff((np.arange(2 * export.LONGEST_S * 30) / 30).astype(np.float32))
    assert np.abs(later_s - 1 / 30).max() > 1e-4  # else there were nothing to do
    monkeypatch.setattr(export, "LONGEST_S", 1)
    bag = BagMaker().skin("/skin", 2.5).write(tmp_path / "bag")
    said = printed("export", bag, *DATASET, tmp_path / "out").err
    assert "2 episodes begin only because the one before is 1 s long" in said
    found = rows(tmp_path / "out")
    lengths = np.bincount(found["episode_index"]).tolist()
    assert lengths[:-1] == [30, 30] and 0 < lengths[-1] < 30
    assert (np.diff(found["unix_time_ns"]) < 1e9 / 29).all()  # no row is lost


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
    seen_ns = [seen for seen, topic, *_ in maker.messages if topic == "/skin/tactile"][STRAY]
    change = "UPDATE messages SET timestamp = ? WHERE timestamp = ?"
    file = maker.write(path, sqlite=True) / f"{path.name}.db3"
    with closing(sqlite3.connect(file)) as base, base:
        assert base.execute(change, (time_ns, seen_ns)).rowcount == 1
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
