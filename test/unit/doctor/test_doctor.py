# SPDX-License-Identifier: Apache-2.0

"""tactile-cdma doctor from the command line, on sound and on faulty ports."""

import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tactile_cdma.base import shipped
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.doctor import installation
from tactile_cdma.doctor.report import Grade
from tactile_cdma.wire.messages import FrameLayout, Info
from tactile_cdma.wire.packets import PacketWriter, wrap
from tactile_cdma.wire.port import Port
from test.support.boards import board, board_id, chattering, plugged
from test.support.programs import run_python

Doctor = Callable[..., tuple[int, dict[str, str]]]


@pytest.fixture
def doctor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Doctor:
    """Runs the command; its exit code, and verdict and text of what it found by subject.

    params: lines of a parameter file that it is given, in half a second.
    """

    def run(*arguments: str, params: Sequence[str] = ()) -> tuple[int, dict[str, str]]:
        if params:
            path = tmp_path / "params.yaml"
            path.write_text("\n    ".join(["/**:\n  ros__parameters:", *params]))
            arguments = (*arguments, "--params", str(path), "--seconds", "0.5")
        code = main(["doctor", "--json", *arguments])
        found = json.loads(capsys.readouterr().out)
        assert code == int(any(check["verdict"] == "problem" for check in found))
        return code, {f["subject"]: f"{f['verdict']}: {f['text']}" for f in found}

    return run


def test_a_sound_board_passes(doctor: Doctor) -> None:
    with plugged(board(3)) as port:
        named = f'digitizer_id: "{board_id(3)}"', "nodes: 16", f"port: {port}"
        code, found = doctor(params=named)
    assert code == 0
    assert board_id(3) in found["digitizer"]
    assert "0 lost" in found.pop("frames")  # the rate of half a second is the scheduler's
    assert {text.split(":")[0] for text in found.values()} == {"ok"}
    assert found["nodes"] == "ok: 16 of 16 spoke"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is the digitizer powered and started"),
        (b"hello, this is a 3D printer\r\n", "another program's firmware"),
        (wrap(b"\x01\0\0" + b"\x63" + bytes(70)), "protocol version 99"),
    ],
)
def test_ports_with_something_else(doctor: Doctor, content: bytes, said: str) -> None:
    with chattering(content) as port:
        code, found = doctor(port)
    assert code == 1
    assert any(text.startswith("problem") and said in text for text in found.values())


def test_a_digitizer_that_only_introduces_itself(doctor: Doctor) -> None:
    frame = FrameLayout.of(SkinConfig.of({}).spec, 4)
    info = Info(frame=frame, sample_rate_uhz=80_000_000_000, volts_per_count=1e-3, sync_mode=1)  # type: ignore[arg-type]
    with chattering(PacketWriter().encode(info)) as port:
        code, found = doctor(port)
    assert code == 1
    assert "sends no frames" in found["frames"]


@pytest.mark.parametrize(
    ("port", "said"),
    [
        ("usb://NOSUCH", "no port has this USB serial number"),
        (__file__, "not a serial port"),
        ("sim://?scene=nonsense", "scene"),
    ],
)
def test_ports_that_do_not_open(doctor: Doctor, port: str, said: str) -> None:
    code, found = doctor(port)
    assert code == 1
    assert said in found["port"]


def test_a_busy_port(doctor: Doctor) -> None:
    with chattering() as port, Port(port, 115_200):
        code, found = doctor(port)
    assert code == 1
    assert "busy" in found["port"]


@pytest.mark.parametrize(
    ("lines", "port", "subject", "said"),
    [
        (["order: 24"], "sim://?order=20&speed=9", "frames", "order 20 (parameters: 24)"),
        (['digitizer_id: "0000000000000001"'], "sim://?speed=9", "digitizer", "wrong digitizer"),
        (["digitizer_id: 1234567890123456"], "sim://", "parameters", "must be a text"),
        (["nodes: 16", "nodez: 4"], "sim://", "parameters", "did you mean 'nodes'"),
        (["nodes: 900", "frame_period_ms: 20.0"], "sim://", "parameters", "longer than its period"),
        (
            ["amplitude_mv: 900.0"],
            "sim://?scene=all&speed=4",
            "amplitude_mv",
            "looks like 300, not 900",
        ),
    ],
)
def test_parameters_that_do_not_fit(
    doctor: Doctor, lines: list[str], port: str, subject: str, said: str
) -> None:
    code, found = doctor(port, params=lines)
    assert code == 1
    assert said in found[subject]


def test_nodes_that_would_go_stale_between_heartbeats(doctor: Doctor) -> None:
    code, found = doctor("sim://?speed=9", params=["frame_period_ms: 40.0", "stale_after_s: 0.9"])
    assert code == 0
    assert found["parameters"].startswith("warning")
    assert "stale_after_s is 0.9 s, but nodes at rest speak every 1 s" in found["parameters"]


def test_that_frames_are_in_doubt_is_told_with_the_reason(doctor: Doctor) -> None:
    _, found = doctor("sim://?scene=all&threshold=0&rail=1", params=["nodes: 16"])
    assert re.match(r"warning: \d+ of \d+ frames in doubt \(.*: \d+", found["certificate"])


def test_that_a_sound_skin_is_certified_is_told(doctor: Doctor) -> None:
    _, found = doctor("sim://?scene=press", params=["nodes: 16"])
    assert re.match(r"ok: \d of \d+ frames in doubt", found["certificate"])


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe", b"just: yaml", b"[1"])
def test_parameter_files_that_are_none(
    doctor: Doctor, tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "params.yaml"
    if content is not None:
        path.write_bytes(content)
    code, found = doctor("sim://", "--params", str(path))
    assert code == 1
    assert str(path) in found["parameters"]


# The installation: folders stand for those of a computer.


def test_versions_outside_of_their_ranges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the file that pip reads, too."""
    root = Path(__file__).resolve().parents[3]
    wanted = installation.requirements()
    assert wanted == [
        line for line in (root / "requirements.txt").read_text().splitlines() if line[0] != "#"
    ]
    assert {check.verdict for check in installation.packages()} == {Grade.OK}
    (tmp_path / "package.xml").touch()
    (tmp_path / "requirements.txt").write_text("numpy>=99\nno-such-package>=1\n???\n")
    monkeypatch.setattr(shipped, "CHECKOUT", tmp_path)
    old, missing, wrong = installation.packages()
    assert (old.verdict, missing.verdict, wrong.verdict) == (
        Grade.WARNING,
        Grade.PROBLEM,
        Grade.WARNING,
    )
    assert "outside of the tested >=99" in old.text


def test_a_kernel_that_does_not_load_is_a_problem_that_says_how_to_build_it() -> None:
    check = installation.compiled_kernel()
    assert check.verdict == "ok" and re.fullmatch("[148] values at once", check.text)
    program = (
        "import sys; sys.modules['tactile_cdma._kernel'] = None\n"
        "from tactile_cdma.doctor.installation import compiled_kernel; print(compiled_kernel())"
    )
    run = run_python("-c", program)
    assert "problem" in run.stdout
    assert "the compiled kernel does not load" in run.stdout and "pip install ." in run.stdout


def test_the_udev_rule_and_programs_that_take_ports(tmp_path: Path) -> None:
    assert list(installation.udev_rule(tmp_path)) == []  # no udev, as in a container
    (tmp_path / "run" / "udev").mkdir(parents=True)
    (tmp_path / "run" / "udev" / "control").touch()
    (tmp_path / "proc" / "12").mkdir(parents=True)
    (tmp_path / "proc" / "12" / "comm").write_text("ModemManager\n")
    (tmp_path / "proc" / "13" / "comm").mkdir(parents=True)  # cannot be read, as one that has ended
    assert [f.verdict for f in installation.udev_rule(tmp_path)] == [Grade.WARNING]
    assert [f.subject for f in installation.port_takers(tmp_path)] == ["ModemManager"]
    rules = tmp_path / "etc" / "udev" / "rules.d"
    rules.mkdir(parents=True)
    rule = rules / installation.RULES
    rule.write_bytes((shipped.CHECKOUT / "config" / installation.RULES).read_bytes())
    assert [f.verdict for f in installation.udev_rule(tmp_path)] == [Grade.OK]
    assert list(installation.port_takers(tmp_path)) == []
    (rules / "85-brltty.rules").touch()
    (tmp_path / "proc" / "12" / "comm").write_text("bash\n")
    [taker] = installation.port_takers(tmp_path)
    assert "sudo apt remove brltty" in taker.text
    rule.write_text("# of last year\n")
    [old] = installation.udev_rule(tmp_path)
    assert old.verdict is Grade.WARNING
    assert "is not that of this version" in old.text


def test_a_segment_without_a_size_is_named(tmp_path: Path) -> None:
    """One that Fast DDS waits for; those that are just being made, locks and data are none."""
    for name, content in (("fastrtps_port7411", "data"), ("fastrtps_port7411_el", "")):
        (tmp_path / name).write_text(content)
    port = tmp_path / "fastdds_port7413"
    port.touch()
    assert [f.verdict for f in installation.shared_memory(tmp_path)] != [Grade.PROBLEM]
    for path in tmp_path.iterdir():
        os.utime(path, (0, 0))
    [found] = installation.shared_memory(tmp_path)
    assert found.verdict is Grade.PROBLEM
    assert found.text.startswith(f"{port}: ")
    port.unlink()
    assert [f.verdict for f in installation.shared_memory(tmp_path)] != [Grade.PROBLEM]


def test_a_program_without_our_packages_says_what_is_missing(tmp_path: Path) -> None:
    """An interpreter that has nothing but its standard library."""
    root = Path(__file__).resolve().parents[3]
    program = (
        "import sys, runpy; sys.path = [p for p in sys.path if 'site-packages' not in p];"
        f"sys.path.insert(0, {str(root)!r}); sys.argv = ['doctor', *sys.argv[1:]];"
        "runpy.run_module('tactile_cdma.doctor', run_name='__main__')"
    )
    installed = run_python("-I", "-S", "-c", program, cwd=tmp_path)
    assert installed.returncode == 1
    assert "problem  packaging: missing" in installed.stdout
    assert "Traceback" not in installed.stderr
    on_port = run_python("-I", "-S", "-c", program, "sim://", cwd=tmp_path)
    assert on_port.returncode == 1
    assert "problem  packages: No module named" in on_port.stdout
    assert "Traceback" not in on_port.stderr
