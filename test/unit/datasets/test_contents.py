# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma info` of whatever holds a skin's frames: the same facts about the same frames."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from tactile_cdma.sim.options import SimOptions
from test.support.bags import PERIOD_S, BagMaker
from test.support.command_line import Printed, Refused
from test.support.simulated import recording

pytestmark = pytest.mark.xdist_group("datasets")
SECONDS = 2.0
NANO = 10**9


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second without taxel 2, and 10 of 156 frames missing."""
    maker = BagMaker().skin("/skin", SECONDS, lambda t_s: [2] if t_s < 0.5 else [])
    maker.without("/skin/tactile", *range(100, 104), *range(120, 126))
    return maker.write(tmp_path_factory.mktemp("contents") / "session")


def said(path: Path, printed: Printed) -> dict[str, str]:
    return dict(line.partition(": ")[::2] for line in printed("info", path).out.splitlines())


def test_rate_gaps_invalid_readings_and_where_they_come_from(
    bag: Path, tmp_path: Path, printed: Printed
) -> None:
    out = printed("export", bag, "-o", tmp_path / "out.npz").out
    assert "frames=146 missing_frames=10 taxels=16" in out
    lines = said(bag, printed)
    length_s = 155 * PERIOD_S
    assert lines["frames"] == f"146 in {length_s:.3f} s, {145 / length_s:.2f} Hz"
    assert lines["gaps"] == (
        f"2, 10 frame periods without a frame, the longest {7 * PERIOD_S:.3f} s after "
        f"{119 * PERIOD_S:.3f} s"
    )
    unknown = sum((i + 0.5) * PERIOD_S < 0.5 for i in range(156))
    assert lines["readings"].startswith(f"{unknown / 146 / 16:.2%} invalid, 0.00% held")
    assert lines["complete"].startswith(f"after {unknown * PERIOD_S:.3f} s")
    assert "--from-first-complete" in lines["complete"]
    assert (lines["skin"], lines["calibration"]) == ("palm-1", "abcd1234")
    assert lines["measured by"] == "simulated 73696D0002000000: no sensor measured this"


def test_a_recording_and_a_bag_of_it_say_the_same(tmp_path: Path, printed: Printed) -> None:
    of_all = SimOptions(scene="moving", dead="5", threshold=0)  # who is alive speaks in every frame
    whole, bag = recording(tmp_path / "touch.skin", of_all, 0.5), tmp_path / "touch"
    printed("export", whole, "-o", bag, "--bag")
    for path, word in ((whole, "lost"), (bag, "missing")):
        out = printed("export", path, "-o", tmp_path / f"{word}.npz").out
        assert f" {word}_frames=0 taxels=16 file=" in out
    of_recording, of_bag = said(whole, printed), said(bag, printed)
    for name in ("gaps", "readings", "complete"):
        assert of_recording[name] == of_bag[name]
    assert of_recording["complete"] == "never: no valid reading of taxel 4"
    assert "/skin/tactile" in of_bag and "measured by" in of_bag


def test_nothing_is_said_of_gaps_and_readings_without_a_frame(
    tmp_path: Path, printed: Printed
) -> None:
    path = recording(tmp_path / "touch.skin", SimOptions(scene="moving"), 0.4)
    assert said(path, printed)["frames"].endswith(", lost 0")
    blind = printed("info", path, "--order", 24).out
    assert "frames: none" in blind and "packets: " in blind
    assert "gaps" not in blind and "readings" not in blind and "complete" not in blind
    assert "samples: none" in blind


@pytest.mark.parametrize("again_s", [30.0, 1.0])
def test_a_driver_that_restarted_is_told_with_its_gap(
    tmp_path: Path, printed: Printed, again_s: float
) -> None:
    """1 s of frames, and as many from another run; by chance a frame is missing in the second."""
    maker, later = BagMaker(), BagMaker()
    maker.skin("/skin", 1.0)
    later.skin("/skin", 1.0)
    later.without("/skin/info").without("/skin/tactile", 50)
    for seen_ns, topic, kind, array in later.messages:
        array.header.stamp.sec += round(again_s) + 1
        maker.messages.append((seen_ns + round(again_s + 1) * NANO, topic, kind, array))
    bag, table = maker.write(tmp_path / "bag"), tmp_path / "out.npz"
    pause_s = again_s + 1 - 77 * PERIOD_S
    told = (
        f"1, 1 frame periods without a frame, the longest {2 * PERIOD_S:.3f} s after "
        f"{again_s + 1 + 49 * PERIOD_S:.3f} s; 1 where the sequence begins anew (did the driver "
        f"restart?), the longest {pause_s:.3f} s after {77 * PERIOD_S:.3f} s"
    )
    assert said(bag, printed)["gaps"] == told
    output = printed("export", bag, "-o", table)
    assert "frames=155 missing_frames=1 " in output.out
    assert f"{bag}: skin: 1 where the sequence begins anew" in output.err
    assert f"missing in the {pause_s:.3f} s" in output.err


def test_a_bag_without_a_skin_is_not_deserialised(tmp_path: Path, printed: Printed) -> None:
    maker = BagMaker().joints("/joint_states", 0.1).spoilt("/joint_states", 3)
    lines = said(maker.write(tmp_path / "bag"), printed)
    assert lines["/joint_states"].startswith("sensor_msgs/msg/JointState, 10 messages")


def test_tables_are_not_taken_for_captures(
    bag: Path, tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    kinds = {"npz": "NPZ", "csv": "CSV"}
    if find_spec("pyarrow"):
        kinds["parquet"] = "Parquet"
    for suffix, kind in kinds.items():
        table = tmp_path / f"out.{suffix}"
        assert f"file={table}" in printed("export", bag, "-o", table).out
        for words in (["export", table, "-o", tmp_path / "y.csv"], ["decode", table]):
            assert f"{table}: {kind}, such as export writes" in refused(*words)
    said = refused("info", tmp_path / "out.csv")
    assert "neither a recording nor a bag; exported files say themselves where they" in said


def test_text_is_told_whatever_the_output(tmp_path: Path, refused: Refused) -> None:
    pytest.importorskip("pyarrow")
    text = tmp_path / "text.txt"
    text.write_text("0.0,1.0\n0.1,1.0\n")
    for output in (["-o", tmp_path / "x.npz"], ["--lerobot", tmp_path / "x", "--fps", "30"]):
        assert f"{text}: is text; decode --json makes frames of" in refused("export", text, *output)


@pytest.mark.parametrize("scramble", ["--scramble", "--no-scramble"])
def test_a_recording_s_chips(tmp_path: Path, printed: Printed, scramble: str) -> None:
    path = tmp_path / "touch.skin"
    printed("record", "sim://?scene=moving", path, "--seconds", 0.5, scramble)
    expected = ", scrambled" if scramble == "--scramble" else ", not scrambled"
    assert f", 50 µs chips{expected}, a frame every 12.8 ms" in said(path, printed)["skin"]


def test_a_dataset_of_other_chips_says_why_it_has_no_row(tmp_path: Path, refused: Refused) -> None:
    pytest.importorskip("pyarrow")
    path = recording(tmp_path / "touch.skin", SimOptions(scene="press"), 0.5)
    words = ["export", path, "--lerobot", tmp_path / "out", "--fps", "30", "--scramble"]
    assert "no row is whole: the digitizer is set to scramble false (parameters" in refused(*words)


@pytest.mark.parametrize("name", ["none.npz", "some.npz", "some.parquet", "some.txt", "folder"])
def test_what_is_none_of_these(tmp_path: Path, refused: Refused, name: str) -> None:
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif not name.startswith("none"):
        path.write_bytes(b"PK\x03\x04 something else")
    assert refused("info", path)
