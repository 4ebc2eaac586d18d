# SPDX-License-Identifier: Apache-2.0

"""The command line: record, decode, simulate, error messages, and words that may be unheard."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.line_packets import config_of, introduction, packets
from tactile_cdma.base.text import listed
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.commands.cli import SUBCOMMANDS, main
from tactile_cdma.sim.channel import Channel
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.packets import PacketWriter
from test.support import simulated
from test.support.command_line import Printed, Refused
from test.support.independent_line import SILENT, Digitizer, Line, Recording, Skin, Talk, render
from test.support.programs import run_program, started
from test.support.simulated import scope_capture
from test.support.waiting import PATIENCE_S

pytestmark = pytest.mark.xdist_group("cli")  # its recording is made once
ROOT = Path(__file__).resolve().parents[3]
COMMAND = [sys.executable, "-m", "tactile_cdma"]


def frames_of(text: str) -> list[dict]:
    return [json.loads(line) for line in text.splitlines()]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of the simulated skin with every node speaking."""
    path = tmp_path_factory.mktemp("recording") / "skin.skin"
    return simulated.recording(path, SimOptions(scene="all", seed=3, threshold=0), 2.0)


@pytest.fixture
def capture(recording: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(recording, tmp_path))


def test_a_recording_decodes_without_being_told_anything(capture: Path, printed: Printed) -> None:
    out, err = printed("decode", capture, "--json")
    frames = frames_of(out)
    assert len(frames) > 60
    assert all(len(frame["nodes"]) == 16 for frame in frames)
    steps = [b["t"] - a["t"] for a, b in pairwise(frames)]
    assert steps == pytest.approx([12.8e-3] * len(steps), abs=2e-6)
    assert "crc_errors=0" in err
    node = frames[0]["nodes"][0]
    assert node["code"] == int(node["bits"], 2)
    assert node["voltage"] == pytest.approx(node["code"] * 3.3 / 1024, abs=1e-4)


@pytest.mark.parametrize("told", [True, False])
def test_a_scope_capture_of_scrambled_nodes_is_decoded_if_told_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], told: bool
) -> None:
    spec, path = FrameSpec(scramble=True, parity=True), tmp_path / "scope.csv"
    codes = np.arange(16) * 60 + 17
    frames = [(codes, np.ones(16, bool))] * 6
    time_s, volts = scope_capture(spec, frames, 200e3, Channel(noise_rms_v=0.01))
    np.savetxt(path, np.column_stack((time_s, volts)), delimiter=",")
    options = ["--timing", "gap", "--parity", "--scramble" if told else "--no-scramble", "--json"]
    main(["decode", str(path), *options])
    found = frames_of(capsys.readouterr().out)
    said = [[node["code"] for node in frame["nodes"]] for frame in found]
    assert (said == [codes.tolist()] * 6) is told


def test_a_truncated_recording_gives_its_whole_frames_a_line_each(
    capture: Path, printed: Printed
) -> None:
    whole = printed("decode", capture, "--json").out.splitlines()
    capture.write_bytes(capture.read_bytes()[: capture.stat().st_size // 2])
    out, err = printed("decode", capture, "--json")
    assert "cut short" in err
    half = out.splitlines()
    assert 0 < len(half) < len(whole)
    assert half == whole[: len(half)]
    assert "kPa" in printed("decode", capture).out.splitlines()[0]


def test_a_parameter_file_serves_decoding(tmp_path: Path, capture: Path, printed: Printed) -> None:
    params = tmp_path / "plain.yaml"
    params.write_text("/**: {ros__parameters: {nodes: 16, amplitude_mv: 300.0}}")
    said = printed("decode", capture, "--json", "--params", params)
    assert len(frames_of(said.out)) > 60
    said = printed("decode", capture, "--params", ROOT / "config/skin.yaml", code=1).err
    assert "scramble false (parameters: scramble true)" in said
    said = printed("decode", capture, "--order", "24", code=1).err
    assert "order 20 (parameters: 24)" in said


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"\0" * 50, "no valid packet"),
        (bytes(range(256)) * 40, "no valid packet: wrong baud rate?"),
        (b"just some words", "no lines of numbers"),
    ],
)
def test_broken_captures(tmp_path: Path, refused: Refused, content: bytes, message: str) -> None:
    path = tmp_path / "broken"
    path.write_bytes(content)
    err = refused("decode", path)
    assert message in err and str(path) in err


def test_what_the_system_refuses_is_one_clear_error(refused: Refused) -> None:
    assert "File name too long" in refused("record", "sim://", "x" * 300)


def test_a_terminal_of_another_alphabet_is_served() -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    run = run_program(*COMMAND, "decode", "--help", cwd=ROOT, env=environment)
    assert run.returncode == 0
    assert "\\xb5s" in run.stdout and run.stderr == ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frame-period-ms", "9"], "longer than its period"),
        (["--timing", "line"], "use --timing gap"),
        (["--params", "/nowhere.yaml"], "/nowhere.yaml: No such file"),
    ],
)
def test_bad_options(tmp_path: Path, refused: Refused, options: list[str], message: str) -> None:
    path = tmp_path / "scope.csv"
    path.write_text("\n".join(f"{i * 5e-6:.6f},{i % 7}" for i in range(400)))
    assert message in refused("decode", path, *options)


def test_recordings_are_not_overwritten_by_accident(capture: Path, refused: Refused) -> None:
    assert "--force overwrites it" in refused("record", "sim://", capture, "--seconds", "0.2")
    assert main(["record", "sim://", str(capture), "--seconds", "0.5", "--force"]) == 0


def test_a_recording_follows_no_link_and_needs_a_port(tmp_path: Path, refused: Refused) -> None:
    link, target = tmp_path / "touch.skin", tmp_path / "authorized_keys"
    link.symlink_to(target)
    assert "File exists" in refused("record", "sim://", link, "--seconds", "0.1")
    assert not target.exists()
    path = tmp_path / "new.raw"
    assert "no such port" in refused("record", "/dev/ttyNOSUCH", path)
    assert not path.exists()


def test_simulate_serves_a_tty_until_interrupted(tmp_path: Path) -> None:
    link, raw = tmp_path / "skin", tmp_path / "skin.skin"
    command = [*COMMAND, "simulate", "--pty", "--link", link, "sim://?scene=all&seed=1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with started(command, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        assert str(link) in process.stdout.readline()
        assert main(["record", str(link), str(raw), "--seconds", "2"]) == 0
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
    assert not link.exists()
    assert raw.stat().st_size > 20_000


def test_simulate_ends_by_itself_and_refuses_bad_options(refused: Refused) -> None:
    assert main(["simulate", "--pty", "--seconds", "0.3"]) == 0
    assert "behind a tty cannot be pressed" in refused("simulate", "--pty", "sim://?scene=external")
    assert "moving" in refused("simulate", "--pty", "sim://?scene=dance")


@pytest.mark.parametrize("command", SUBCOMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        main([command, "--help"])
    assert command in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "completions"),
    [("tactile-cdma de", {"decode"}), ("tactile-cdma export t.skin --b", {"--bag", "--bits"})],
)
def test_a_shell_that_asks_is_told_what_can_follow(line: str, completions: set[str]) -> None:
    pytest.importorskip("argcomplete")
    asks = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_LINE": line}
    command = f"{sys.executable} -m tactile_cdma 8>&1 9>&2"  # it answers on 8
    environment = os.environ | asks | {"COMP_POINT": str(len(line))}
    answer = run_program("sh", "-c", command, env=environment)
    assert set(answer.stdout.split()) == completions


def test_examples_are_copied_as_documents_name_them(
    printed: Printed, refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "new"
    printed("examples", folder)
    monkeypatch.chdir(folder)
    for name in ("config/layouts/cylinder.yaml", "examples/mujoco_skin.py", "urdf/skin.urdf.xacro"):
        assert Path(name).read_bytes() == (ROOT / name).read_bytes()
    printed("layout", "config/layouts/cylinder.yaml")
    printed("decode", "examples/scope.csv", "--params", "config/paper_skin.yaml")
    assert not list(folder.rglob("__pycache__"))
    Path("config/skin.yaml").write_text("own")
    assert "config: File exists" in refused("examples", folder)
    assert Path("config/skin.yaml").read_text() == "own"


FRAMES = 12


@dataclass(frozen=True)
class Printing:
    """A file, how it is decoded, and when its frames began, s."""

    recording: Recording
    path: Path
    options: tuple[str, ...]

    def sent(self, t_s: float) -> set[int]:
        """Numbers of the nodes that spoke in the frame that began then."""
        chip_s = self.recording.skin.chip_s
        frame = min(self.recording.frames, key=lambda one: abs(one.start_chips * chip_s - t_s))
        assert abs(frame.start_chips * chip_s - t_s) < 100 * chip_s
        return set((np.flatnonzero(frame.codes != SILENT) + 1).tolist())


def scope(folder: Path, line: Line) -> Printing:
    digitizer = Digitizer(samples_per_chip=8, marked=False)
    recording = render(Skin(), Talk(), line, digitizer, FRAMES, 3)
    path = folder / "scope.csv"
    counts = np.concatenate([run.counts for run in recording.runs])
    t_s = (recording.runs[0].t_chips + np.arange(len(counts)) / 8) * recording.skin.chip_s
    volts = counts * digitizer.volts_per_count
    np.savetxt(path, np.column_stack((t_s, volts)), delimiter=",", fmt="%.9f")
    return Printing(recording, path, ("--timing", "gap", "--nodes", "16"))


def raw(folder: Path, line: Line) -> Printing:
    digitizer = Digitizer(samples_per_chip=4)
    recording = render(Skin(), Talk(), line, digitizer, FRAMES, 3)
    path, writer = folder / "line.raw", PacketWriter()
    told = writer.encode(introduction(config_of(recording.skin, digitizer), digitizer))
    path.write_bytes(2 * told + b"".join(data for *_, data in packets(recording, writer)))
    return Printing(recording, path, ())


SOME = range(0, 16, 3)


@pytest.mark.parametrize(
    ("made", "faint"),
    [(scope, SOME), (raw, SOME), (raw, range(16))],
    ids=["scope", "digitizer", "all of them"],
)
def test_who_spoke_unheard_is_printed_as_doubtful(
    tmp_path: Path, printed: Printed, made: Callable[[Path, Line], Printing], faint: range
) -> None:
    printing = made(tmp_path, Line(noise_v=0.02, gains=tuple((node, 0.2) for node in faint)))
    command = "decode", printing.path, "--amplitude-mv", 300, *printing.options
    shown, lines = printed(*command, "--json").out.splitlines(), printed(*command).out.splitlines()
    unheard = 0
    for frame, line in zip(map(json.loads, shown), lines, strict=True):
        doubtful = frame["doubtful_silence"]
        heard = {node["node"] for node in frame["nodes"]}
        missed = printing.sent(frame["t"]) - heard
        unheard += len(missed)
        assert missed <= set(doubtful) and not heard & set(doubtful)
        assert ("all silent" in line) == (not heard and not doubtful)
        assert line.endswith(f"silence doubtful: {listed(doubtful, 'node')}") == bool(doubtful)
    assert unheard > 5, "nothing was missed"
