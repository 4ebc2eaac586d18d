# SPDX-License-Identifier: Apache-2.0

"""Export and info: options that an output lacks; writers, readers, viewers of other packages."""

import json
import lzma
import os
import re
import shutil
from pathlib import Path

import pytest

from tactile_cdma.commands.cli import main
from tactile_cdma.sim.options import SimOptions
from test.support.bags import BagMaker
from test.support.command_line import Refused
from test.support.programs import run_python
from test.support.simulated import recording

pytestmark = pytest.mark.xdist_group("export options")  # its files are made once
OF_CHOICE = "--topic /skin/tactile|--start 0|--end 2|--episode 0:1|--marks /m|--from-first-complete"
OF_DATASET = (
    "--fps 30|--clock /c|--samples window|--nan hold|--image /i|--state /s|--action /a|--task grip"
)
CHOICES, OF_LEROBOT, OF_SKIN = (
    [option.split() for option in options.split("|")]
    for options in (OF_CHOICE, OF_DATASET, "--nodes 99|--vref 1.0|--no-parity|--params skin.yaml")
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("options")
    found = {"bag": BagMaker().skin("/skin", 0.3).write(folder / "bag")}
    found["recording"] = recording(folder / "touch.skin", SimOptions(), 0.3)
    found["table"] = folder / "out.npz"
    assert main(["export", str(found["bag"]), "-o", str(found["table"])]) == 0
    return found


@pytest.mark.parametrize("option", [*CHOICES, *OF_LEROBOT], ids=lambda option: option[0])
def test_a_bag_is_all_of_a_recording(
    files: dict[str, Path], tmp_path: Path, refused: Refused, option: list[str]
) -> None:
    out = tmp_path / "out"
    reason = "with --bag" if option in CHOICES else "goes with --lerobot"
    said = refused("export", files["recording"], "-o", out, "--bag", *option)
    assert option[0] in said and reason in said and not out.exists()


@pytest.mark.parametrize("option", OF_LEROBOT, ids=lambda option: option[0])
@pytest.mark.parametrize("kind", ["bag", "recording"])
def test_a_table_has_the_skin_s_own_frames(
    files: dict[str, Path], tmp_path: Path, refused: Refused, kind: str, option: list[str]
) -> None:
    said = refused("export", files[kind], "-o", tmp_path / "out.npz", *option)
    assert (
        f"{option[0]} goes with --lerobot, *.hdf5 or *.zarr: other tables have the skin's own"
        in said
    )
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize("option", OF_SKIN, ids=lambda option: option[0])
def test_what_was_decoded_before_is_not_decoded_anew(
    files: dict[str, Path], tmp_path: Path, refused: Refused, option: list[str]
) -> None:
    if option[0] == "--params":
        file = tmp_path / option[1]
        file.write_text("skin:\n  ros__parameters:\n    vref_v: 1.0\n    parity: true\n")
        option = ["--params", str(file)]
    bag, out = files["bag"], tmp_path / "out.npz"
    for words in (["info", bag], ["export", bag, "-o", out]):
        said = refused(*words, *option)
        assert f"{bag}: --params and the skin's options (" in said
        assert "are for recordings" in said
        named = {"--nodes": "nodes", "--vref": "vref_v", "--no-parity": "parity"}
        assert f"({named.get(option[0], 'parity, vref_v')})" in said
    assert not out.exists()


EXAMPLE = Path(__file__).resolve().parents[3] / "examples/own_formats.py"
GROUP = re.compile(r'\[project\.entry-points\."(.*)"\]\n    (.*) = "(.*)"')


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """As after `pip install` of the module, and of what its docstring says of pyproject.toml."""
    shutil.copy(EXAMPLE, tmp_path)
    about = tmp_path / "own_formats-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: own_formats\nVersion: 1.0\n")
    groups = GROUP.findall(EXAMPLE.read_text(encoding="utf-8"))
    assert len(groups) == 3
    points = "".join(f"[{group}]\n{name} = {place}\n" for group, name, place in groups)
    (about / "entry_points.txt").write_text(points)
    root = str(EXAMPLE.parents[1])
    return os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), root))}


def test_they_are_used_like_those_built_in(tmp_path: Path, environment: dict[str, str]) -> None:
    def run(*words: str | Path) -> str:
        done = run_python("-m", "tactile_cdma", *words, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    plain = recording(tmp_path / "touch.skin", SimOptions(scene="all", dead="5"), 0.5)
    packed = tmp_path / "touch.skin.xz"
    packed.write_bytes(lzma.compress(plain.read_bytes()))
    said = run("export", packed, "-o", tmp_path / "touch.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "touch.jsonl").open(encoding="utf-8")]
    assert said.startswith(f"frames={len(lines)} ") and len(lines) > 20
    assert lines[-1]["pa"][4] is None and None not in lines[-1]["pa"][5:]
    shown = run("view", "sim://?scene=all", "--viewer", "peak").splitlines()
    assert len(shown) == 10 and re.fullmatch(r"\d+\.\d kPa of 16 taxels", shown[-1])
    failed = run_python(
        "-m", "tactile_cdma", "export", plain, "-o", tmp_path / "touch.odd", env=environment
    )
    assert "*.zarr, *.mp4, *.gif, *.pdf, *.svg, *.png, *.jsonl, or ask" in failed.stderr


def test_without_them_they_are_unknown(tmp_path: Path, refused: Refused) -> None:
    plain = recording(tmp_path / "touch.skin", SimOptions(), 0.2)
    assert "name it *.npz" in refused("export", plain, "-o", tmp_path / "touch.jsonl")
    said = refused("view", "sim://", "--viewer", "peak")
    assert "no installed package has a viewer 'peak'; there are: none" in said
