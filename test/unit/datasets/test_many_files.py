# SPDX-License-Identifier: Apache-2.0

"""Several files as one dataset or table: what they do not have in common is told."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_cdma.sim.options import SimOptions
from test.support.bags import BagMaker
from test.support.command_line import Printed, Refused
from test.support.simulated import recording

pytest.importorskip("pyarrow", reason="the extra [learn] is not installed")

pytestmark = pytest.mark.xdist_group("datasets")
SECONDS = 1.5


def bag(path: Path, contacts: bool = False, seconds: float = SECONDS, **info: Any) -> Path:
    """A bag of a skin; info: fields of its TactileSkinInfo."""
    maker = BagMaker().skin("/skin", seconds)
    for name, value in info.items():
        setattr(maker.messages[0][3], name, value)
    if contacts:
        maker.contacts("/skin", seconds, seconds)
    return maker.write(path)


DATASET = "--fps", 30, "--lerobot"


def meta(folder: Path, name: str) -> Any:
    return json.loads((folder / "meta" / name).read_text())


def test_readings_from_elsewhere_are_told_and_kept_apart(tmp_path: Path, printed: Printed) -> None:
    first = bag(tmp_path / "first")
    others = [
        bag(tmp_path / "board", origin=1, measured_by=1),
        bag(tmp_path / "curves", calibration_id="other"),
        bag(tmp_path / "same"),
    ]
    told = printed("export", first, *others, *DATASET, tmp_path / "out").err
    assert told.splitlines() == [
        f"tactile-cdma: {path}: {key} of patch skin is {its!r}, in the first file {mine!r}"
        for path, key, its, mine in (
            (others[0], "origin", "board", "simulated"),
            (others[0], "measured_by", "board", "simulated"),
            (others[1], "calibration_id", "other", "abcd1234"),
        )
    ]
    patches = meta(tmp_path / "out", "tactile.json")["patches"]
    kept = {one["file"]: (one["measured_by"], one["calibration_id"]) for one in patches}
    assert kept == {
        "first": ("simulated", "abcd1234"),
        "board": ("board", "abcd1234"),
        "curves": ("simulated", "other"),
        "same": ("simulated", "abcd1234"),
    }


def test_a_recording_s_digitizer_is_compared_too(tmp_path: Path, printed: Printed) -> None:
    """It is known only when its frames are decoded."""
    skin = recording(tmp_path / "touch.skin", SimOptions(scene="moving"), 1.0)
    printed("export", skin, "-o", tmp_path / "bag", "--bag")
    said = printed("export", tmp_path / "bag", skin, *DATASET, tmp_path / "out").err
    # Without contacts and wrench, which the bag does not hold.
    assert said.splitlines() == [
        f"tactile-cdma: {tmp_path}/bag: no observation.{kind}.skin, which is left out"
        for kind in ("contacts", "wrench")
    ]


@pytest.mark.parametrize("lacking_first", [False, True])
def test_contacts_that_not_all_files_have_are_left_out(
    tmp_path: Path, printed: Printed, lacking_first: bool
) -> None:
    files = [bag(tmp_path / "with", contacts=True), bag(tmp_path / "without")]
    either = files[::-1] if lacking_first else files
    said = printed("export", *either, *DATASET, tmp_path / "out").err
    for kind in ("contacts", "wrench"):
        assert f"{files[1]}: no observation.{kind}.skin, which is left out" in said
    features = meta(tmp_path / "out", "info.json")["features"]
    assert {name.split(".")[1] for name in features if "." in name} == {"tactile"}
    assert not printed("export", files[0], files[0], *DATASET, tmp_path / "both").err
    assert "observation.contacts.skin" in meta(tmp_path / "both", "info.json")["features"]


def test_other_streams_have_to_be_in_all_files(tmp_path: Path, refused: Refused) -> None:
    maker = BagMaker().skin("/skin", SECONDS).camera("/front/image_raw", SECONDS, 30)
    with_camera, without = maker.write(tmp_path / "with"), bag(tmp_path / "without")
    contacts = bag(tmp_path / "contacts", contacts=True)
    fps = ["--fps", "30"]
    for files, options, problem in (
        ([with_camera, without], fps, "does not have observation.images.front, which the first"),
        ([without, with_camera], fps, "has observation.images.front, which the first file does"),
        ([contacts, without], ["--clock", "/skin/wrench"], "does not have observation.wrench.skin"),
    ):
        words = ["export", *files, "--lerobot", tmp_path / "out", *options]
        assert f"{files[1]}: {problem}" in refused(*words)
    assert not (tmp_path / "out").exists()


def test_tables_do_not_read_contacts(tmp_path: Path, printed: Printed) -> None:
    maker = BagMaker().skin("/skin", 0.3).contacts("/skin", 0.3, 0.3).spoilt("/skin/contacts")
    printed("export", maker.write(tmp_path / "bag"), "-o", tmp_path / "out.npz")


@pytest.mark.parametrize("stray_s", [-3600, 9, 3600])
def test_no_rows_are_made_for_a_pause(tmp_path: Path, printed: Printed, stray_s: int) -> None:
    """An hour off is too little to say which times are wrong: the recorder may have paused."""
    maker = BagMaker().skin("/skin", SECONDS)
    for i, (seen_ns, topic, kind, message) in enumerate(maker.messages):
        if topic == "/skin/tactile" and message.sequence == 40:
            message.header.stamp.sec += stray_s
            maker.messages[i] = (seen_ns + stray_s * 10**9, topic, kind, message)
    words = "--fps", 10, "--lerobot", tmp_path / "out"
    said = printed("export", maker.write(tmp_path / "bag"), *words).err
    info = meta(tmp_path / "out", "info.json")
    if stray_s == 9:  # which is no pause
        assert 90 <= info["total_frames"] <= 97 and len(said.splitlines()) == 1
        assert "/skin/tactile had stopped in 7" in said  # of its rows, which are not valid
        return
    # 10 s after the last sample a pause begins, but for the ticks that waited for that.
    left_out = 10 * (3600 - 12)
    [note] = [line for line in said.splitlines() if "nothing had been recorded for 10 s" in line]
    assert left_out - 20 < int(note.split()[1]) < left_out + 40
    assert 100 < info["total_frames"] < 134
    assert info["total_episodes"] == (2 if stray_s < 0 else 1)  # no row comes after the last sample


def test_an_image_ends_a_pause(tmp_path: Path, printed: Printed) -> None:
    """Every image is a row, also the first one after a pause, before the skin's next frame."""
    maker, later = BagMaker(), BagMaker()
    for one in (maker, later):
        one.skin("/skin", SECONDS)
        one.camera("/front", SECONDS, 30)
    for seen_ns, topic, kind, message in later.messages:
        if topic == "/front" or (topic == "/skin/tactile" and message.sequence > 10):
            message.header.stamp.sec += 20
            maker.messages.append((seen_ns + 20 * 10**9, topic, kind, message))
    bag = maker.write(tmp_path / "bag")
    said = printed("export", bag, "--lerobot", tmp_path / "out", "--clock", "/front")
    assert "episodes=2 frames=90 fps=30 left_out=0 " in said.out
    assert said.err.endswith("/skin/tactile had stopped in 5 rows, where nothing is valid\n")


def test_a_file_that_contributes_nothing_is_told(tmp_path: Path, printed: Printed) -> None:
    short = bag(tmp_path / "short", seconds=0.5, calibration_id="other")
    whole = bag(tmp_path / "whole")
    words = "export", short, whole, "--episode", "1:1.4"
    said = printed(*words, *DATASET, tmp_path / "out").err
    assert said == f"tactile-cdma: {short}: no row in its episodes\n"
    about = meta(tmp_path / "out", "tactile.json")
    assert about["files"] == ["whole"] and [one["file"] for one in about["patches"]] == ["whole"]

    table = tmp_path / "out.npz"
    said = printed(*words, "-o", table).err
    assert said == f"tactile-cdma: {short}: no frame of skin in its episodes\n"
    with np.load(table) as found:
        about = json.loads(str(found["about"]))
        assert set(found["episode"]) == {1} and about["files"] == ["short", "whole"]
    # What is said of the readings is of the file that they come from.
    assert (about["file"], about["calibration_id"]) == ("whole", "abcd1234")
