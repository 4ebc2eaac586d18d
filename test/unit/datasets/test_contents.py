# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma info` of whatever holds a skin's frames: the same facts about the same frames."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from tactile_cdma.commands.cli import main
from tactile_cdma.sim.options import SimOptions
from test.support.bags import PERIOD_S, BagMaker
from test.support.command_line import Refused
from test.support.simulated import recording

pytestmark = pytest.mark.xdist_group("datasets")
SECONDS = 2.0
NANO = 10**9


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second without taxel 2, and 10 of 156 frames missing."""
    maker = BagMaker().skin("/skin", SECONDS, lambda t_s: [2] if t_s < 0.5 else [])
    arrays = [message for message in maker.messages if message[1] == "/skin/tactile"]
    for lost in (*arrays[100:104], *arrays[120:126]):
        maker.messages.remove(lost)
    return maker.write(tmp_path_factory.mktemp("contents") / "session")


def said(path: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    assert main(["info", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    return dict(line.partition(": ")[::2] for line in lines)


def test_rate_gaps_invalid_readings_and_where_they_come_from(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(bag), "-o", str(tmp_path / "out.npz")]) == 0
    assert "frames=146 missing_frames=10 taxels=16" in capsys.readouterr().out
    lines = said(bag, capsys)
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
    assert lines["measured by"] == "simulated 73696D0002000000: nothing was touched"


def test_a_recording_and_a_bag_of_it_say_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of_all = SimOptions(scene="moving", dead="5", threshold=0)  # who is alive speaks in every frame
    whole, bag = recording(tmp_path / "touch.skin", of_all, 0.5), tmp_path / "touch"
    assert main(["export", str(whole), "-o", str(bag), "--bag"]) == 0
    for path, word in ((whole, "lost"), (bag, "missing")):
        assert main(["export", str(path), "-o", str(tmp_path / f"{word}.npz")]) == 0
        assert f" {word}_frames=0 taxels=16 file=" in capsys.readouterr().out
    of_recording, of_bag = said(whole, capsys), said(bag, capsys)
    for name in ("gaps", "readings", "complete"):
        assert of_recording[name] == of_bag[name]
    assert of_recording["complete"] == "never: no valid reading of taxel 4"
    assert "/skin/tactile" in of_bag and "measured by" in of_bag


def test_nothing_is_said_of_gaps_and_readings_without_a_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path / "touch.skin", SimOptions(scene="moving"), 0.4)
    assert said(path, capsys)["frames"].endswith(", lost 0")
    assert main(["info", str(path), "--order", "24"]) == 0
    blind = capsys.readouterr().out
    assert "frames: none" in blind and "packets: " in blind
    assert "gaps" not in blind and "readings" not in blind and "complete" not in blind
    assert "samples: none" in blind


@pytest.mark.parametrize("again_s", [30.0, 1.0])
def test_a_driver_that_restarted_is_told_with_its_gap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], again_s: float
) -> None:
    """1 s of frames, and as many from another run; by chance a frame is missing in the second."""
    maker, later = BagMaker(), BagMaker()
    maker.skin("/skin", 1.0)
    later.skin("/skin", 1.0)
    arrays = [message for message in later.messages if message[1] == "/skin/tactile"]
    for seen_ns, topic, kind, array in arrays:
        array.header.stamp.sec += round(again_s) + 1
        if array.sequence != 50:
            maker.messages.append((seen_ns + round(again_s + 1) * NANO, topic, kind, array))
    bag, table = maker.write(tmp_path / "bag"), tmp_path / "out.npz"
    pause_s = again_s + 1 - 77 * PERIOD_S
    told = (
        f"1, 1 frame periods without a frame, the longest {2 * PERIOD_S:.3f} s after "
        f"{again_s + 1 + 49 * PERIOD_S:.3f} s; 1 where the sequence begins anew (did the driver "
        f"restart?), the longest {pause_s:.3f} s after {77 * PERIOD_S:.3f} s"
    )
    assert said(bag, capsys)["gaps"] == told
    assert main(["export", str(bag), "-o", str(table)]) == 0
    output = capsys.readouterr()
    assert "frames=155 missing_frames=1 " in output.out
    assert f"{bag}: skin: 1 where the sequence begins anew" in output.err
    assert f"missing in the {pause_s:.3f} s" in output.err


def test_frames_that_were_never_published_are_not_called_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of a skin at rest with idle_rate_hz."""
    maker = BagMaker().skin("/skin", 1.0)
    maker.messages = [
        one for one in maker.messages if one[1] != "/skin/tactile" or one[3].sequence % 8 == 0
    ]
    bag = maker.write(tmp_path / "bag")
    assert main(["export", str(bag), "-o", str(tmp_path / "out.npz")]) == 0
    output = capsys.readouterr().out
    assert "frames=10 missing_frames=63 " in output and "lost" not in output


def test_a_bag_without_a_skin_is_not_deserialised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maker = BagMaker().joints("/joint_states", 0.1)
    time_ns, topic, kind, _ = maker.messages[3]
    maker.messages[3] = (time_ns, topic, kind, b"\x00\x01\x00\x00odd")
    lines = said(maker.write(tmp_path / "bag"), capsys)
    assert lines["/joint_states"].startswith("sensor_msgs/msg/JointState, 10 messages")


def test_tables_are_not_taken_for_captures(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    kinds = {"npz": "NPZ", "csv": "CSV"}
    if find_spec("pyarrow"):
        kinds["parquet"] = "Parquet"
    for suffix, kind in kinds.items():
        table = tmp_path / f"out.{suffix}"
        assert main(["export", str(bag), "-o", str(table)]) == 0
        assert f"file={table}" in capsys.readouterr().out
        for words in (["export", table, "-o", tmp_path / "y.csv"], ["decode", table]):
            assert f"{table}: {kind}, such as export writes" in refused(*words)
    said = refused("info", tmp_path / "out.csv")
    assert "no recording or bag; what export wrote says where it" in said


def test_text_is_told_whatever_the_output(tmp_path: Path, refused: Refused) -> None:
    pytest.importorskip("pyarrow")
    text = tmp_path / "text.txt"
    text.write_text("0.0,1.0\n0.1,1.0\n")
    for output in (["-o", tmp_path / "x.npz"], ["--lerobot", tmp_path / "x", "--fps", "30"]):
        assert f"{text}: text; of an oscilloscope's capture" in refused("export", text, *output)


@pytest.mark.parametrize("scramble", ["--scramble", "--no-scramble"])
def test_a_recording_s_chips(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], scramble: str
) -> None:
    path = tmp_path / "touch.skin"
    words = ["record", "sim://?scene=moving", path, "--seconds", "0.5", scramble]
    assert main(list(map(str, words))) == 0
    capsys.readouterr()
    expected = ", scrambled" if scramble == "--scramble" else ""
    assert f", 50 µs chips{expected}, a frame every 12.8 ms" in said(path, capsys)["skin"]


@pytest.mark.parametrize("name", ["none.npz", "some.npz", "some.parquet", "some.txt", "folder"])
def test_what_is_none_of_these(tmp_path: Path, refused: Refused, name: str) -> None:
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif not name.startswith("none"):
        path.write_bytes(b"PK\x03\x04 something else")
    assert refused("info", path)
