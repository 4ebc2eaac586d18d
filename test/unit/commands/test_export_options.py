# SPDX-License-Identifier: Apache-2.0

"""Options of `export` and `info` that an output or an input does not have: refused, not ignored."""

from pathlib import Path

import pytest

from tactile_cdma.commands.cli import main
from test.support.bags import BagMaker

pytestmark = pytest.mark.xdist_group("export options")  # its files are made once
CHOICES = [
    ["--topic", "/skin/tactile"],
    ["--start", "0"],
    ["--end", "2"],
    ["--episode", "0:1"],
    ["--marks", "/marks"],
    ["--from-first-complete"],
]
OF_LEROBOT = [
    ["--fps", "30"],
    ["--clock", "/camera"],
    ["--samples", "window"],
    ["--nan", "hold"],
    ["--image", "/nope"],
    ["--state", "/nope"],
    ["--action", "/nope"],
    ["--task", "grip"],
]
OF_SKIN = [["--nodes", "99"], ["--vref", "1.0"], ["--no-parity"], ["--params", "skin.yaml"]]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("options")
    maker = BagMaker()
    maker.skin("/skin", 0.3)
    found = {"bag": maker.write(folder / "bag"), "recording": folder / "touch.skin"}
    words = ["record", "sim://", found["recording"], "--seconds", "0.3", "--nodes", "16"]
    assert main(list(map(str, words))) == 0
    found["table"] = folder / "out.npz"
    assert main(["export", str(found["bag"]), "-o", str(found["table"])]) == 0
    return found


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(words) == 1
    said = capsys.readouterr()
    assert not said.out and len(said.err.splitlines()) == 1
    return said.err


@pytest.mark.parametrize("option", [*CHOICES, *OF_LEROBOT], ids=lambda option: option[0])
def test_a_bag_is_all_of_a_recording(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str]
) -> None:
    out = tmp_path / "out"
    words = ["export", str(files["recording"]), "-o", str(out), "--bag", *option]
    reason = "with --bag" if option in CHOICES else "goes with --lerobot"
    said = refused(words, capsys)
    assert option[0] in said and reason in said and not out.exists()


@pytest.mark.parametrize("option", OF_LEROBOT, ids=lambda option: option[0])
@pytest.mark.parametrize("kind", ["bag", "recording"])
def test_a_table_has_the_skin_s_own_frames(
    files: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
    option: list[str],
) -> None:
    words = ["export", str(files[kind]), "-o", str(tmp_path / "out.npz"), *option]
    said = refused(words, capsys)
    assert f"{option[0]} goes with --lerobot: a table has the skin's own frames" in said
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize("option", OF_SKIN, ids=lambda option: option[0])
def test_what_was_decoded_before_is_not_decoded_anew(
    files: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    option: list[str],
) -> None:
    if option[0] == "--params":
        file = tmp_path / option[1]
        file.write_text("skin:\n  ros__parameters:\n    vref_v: 1.0\n    parity: true\n")
        option = ["--params", str(file)]
    bag, out = str(files["bag"]), tmp_path / "out.npz"
    for words in (["info", bag], ["export", bag, "-o", str(out)]):
        said = refused([*words, *option], capsys)
        assert f"{bag}: --params and the skin's options (" in said
        assert "are for recordings" in said
        named = {"--nodes": "nodes", "--vref": "vref_v", "--no-parity": "parity"}
        assert f"({named.get(option[0], 'parity, vref_v')})" in said
    assert not out.exists()
