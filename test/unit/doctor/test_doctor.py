# SPDX-License-Identifier: Apache-2.0

"""tactile-cdma doctor: sound and faulty ports; each fault is made by changing bytes on the line."""

import json
import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tactile_cdma.base import named_file as shipped
from tactile_cdma.base.errors import PortError
from tactile_cdma.code.frame import UNIPOLAR
from tactile_cdma.commands.cli import main
from tactile_cdma.config.parameters import GAP, Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.doctor import installation
from tactile_cdma.doctor.report import Check, Grade
from tactile_cdma.doctor.stream import Chunks, judge
from tactile_cdma.driver.session import Session
from tactile_cdma.recording.offline import parameters_of
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import LOADS, SCENES
from tactile_cdma.wire.messages import Info, Packet, Quiet, Samples, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter, wrap
from tactile_cdma.wire.port import Port
from test.support.boards import board, board_id, chattering, plugged
from test.support.programs import run_python
from test.support.simulated import introduction

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
        (PacketWriter().encode(introduction(SkinConfig.of({}))), "sends no frames"),
    ],
)
def test_ports_with_something_else(doctor: Doctor, content: bytes, said: str) -> None:
    with chattering(content) as port:
        _, found = doctor(port)
    assert any(text.startswith("problem") and said in text for text in found.values())


def test_a_busy_port(doctor: Doctor) -> None:
    with chattering() as port, Port(port, 115_200):
        _, found = doctor(port)
    assert re.match("problem: .*busy", found["port"])


@pytest.mark.parametrize(
    ("port", "lines", "subject", "said"),
    [
        ("usb://NOSUCH", (), "port", "problem: .*no port has this USB serial number"),
        (__file__, (), "port", "problem: .*not a serial port"),
        ("sim://?scene=nonsense", (), "port", "problem: .*scene"),
        ("sim://?order=20&speed=9", ["order: 24"], "frames", r"problem: .*20 .parameters: 24\)"),
        ("sim://?speed=9", ["digitizer_id: '01 00000000000001'"], "digitizer", "problem: .*wrong"),
        ("sim://", ["digitizer_id: 1234567890123456"], "parameters", "problem: .*must be a text"),
        ("sim://", ["nodes: 16", "nodez: 4"], "parameters", "problem: .*did you mean 'nodes'"),
        ("sim://", ["nodes: 900", "frame_period_ms: 20.0"], "parameters", "problem: .*its period"),
        ("sim://?scene=all&speed=4", ["amplitude_mv: 900.0"], "amplitude_mv", ".*300, not 900"),
        (
            *("sim://?speed=9", ["frame_period_ms: 40.0", "stale_after_s: 0.9"], "parameters"),
            "warning: .*stale_after_s is 0.9 s, but nodes at rest speak every 1 s",
        ),
        (
            *("sim://?scene=all&threshold=0&rail=1", ["nodes: 16"], "certificate"),
            r"warning: \d+ of \d+ frames in doubt \(.*: \d+",
        ),
        ("sim://?scene=press", ["nodes: 16"], "certificate", r"ok: \d of \d+ frames in doubt"),
    ],
)
def test_ports_and_parameters_are_told_of(
    doctor: Doctor, port: str, lines: Sequence[str], subject: str, said: str
) -> None:
    _, found = doctor(port, params=lines)
    assert re.match(said, found[subject]), found[subject]


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe", b"just: yaml", b"[1"])
def test_files_without_parameters(doctor: Doctor, tmp_path: Path, content: bytes | None) -> None:
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
    verdicts = [check.verdict for check in (old, missing, wrong)]
    assert verdicts == ["warning", "problem", "warning"]
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


SECONDS = 0.6
ALL_TALK = "sim://?scene=press&threshold=0&noise=0.01"


def packets_of(url: str, asked: SkinConfig | None = None) -> list[Packet]:
    """What a simulated digitizer sends in a while. asked: how a driver has set it before."""
    now_s, options = 0.0, SimOptions.from_url(url)
    digitizer = VirtualDigitizer(options, lambda: now_s)
    digitizer.receive(Session(asked).open())
    parser, packets = PacketParser(), []
    while now_s < SECONDS:
        now_s += 0.01
        digitizer.advance()
        packets += parser.feed(digitizer.take(1 << 20))
    return [packet for packet in packets if isinstance(packet, Packet)]


def stream_of(packets: list[Packet]) -> Chunks:
    """The same packets on a port, each read when its samples were taken."""
    writer, t_host, chunks = PacketWriter(), 100.0, []
    for packet in packets:
        if isinstance(packet, Samples | Quiet):
            t_host = 100.0 + packet.device_time_us * 1e-6
        chunks.append((writer.encode(packet), t_host))
    return chunks


def info_of(packets: list[Packet]) -> Info:
    """What the digitizer says of itself, at last."""
    return [packet for packet in packets if isinstance(packet, Info)][-1]


def checks(
    packets: list[Packet], no_frames: str | None = None, **values: object
) -> dict[str, list[Check]]:
    """By subject; values: parameters that are not as the digitizer says."""
    known = {**parameters_of(info_of(packets)), "amplitude_mv": 300.0, **values}
    config, found = SkinConfig.of(known), dict[str, list[Check]]()  # type: ignore[arg-type]
    for check in judge(stream_of(packets), config, SECONDS, no_frames):
        found.setdefault(check.subject, []).append(check)
    return found


def judged(chunks: Chunks) -> dict[str, Check]:
    """By subject, what is said of bytes and the times when they were read."""
    return {check.subject: check for check in judge(chunks, SkinConfig.of({}), SECONDS)}


def changed(
    packets: list[Packet], change: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> list[Packet]:
    """Packets of other counts, made of their own and of the times since the frame's mark, s."""
    info = info_of(packets)
    begin, result = 0, list[Packet]()
    for packet in packets:
        if isinstance(packet, Samples):
            begin = packet.first_index if packet.sync else begin
            index = packet.first_index - begin + np.arange(packet.counts.size)
            counts = np.rint(change(packet.counts, index / info.sample_rate_hz))
            packet = replace(packet, counts=counts.astype(np.int16))
        result.append(packet)
    return result


def with_node(packets: list[Packet], others: list[Packet], share: float) -> list[Packet]:
    """The sum of two lines, the second one weakened."""
    result = []
    for a, b in zip_longest(packets, others):
        if isinstance(a, Samples) and isinstance(b, Samples) and len(a.counts) == len(b.counts):
            counts = a.counts + np.round(share * b.counts).astype(np.int16)
            result.append(replace(a, counts=counts))
        elif a is not None:
            result.append(a)
    return result


@cache
def talk(options: str) -> list[Packet]:
    """Of a skin on which all nodes speak."""
    return packets_of(f"{ALL_TALK}&{options}")


SOUND, WITHOUT_5 = "seed=1", "seed=1&dead=5"
ONLY_5 = "seed=2&dead=1,2,3,4,6,7,8,9,10,11,12,13,14,15,16"


def test_a_sound_skin_has_nothing_to_complain_of() -> None:
    found = checks(talk(SOUND))
    verdicts = {check.verdict for subject in found.values() for check in subject}
    assert verdicts == {Grade.OK}
    assert found["nodes"][0].text == "16 of 16 spoke"
    assert float(found["noise"][0].text.split()[0]) == pytest.approx(5.0, rel=0.1)  # of 4 samples


def test_pulses_on_the_data_wire_are_told_by_those_who_speak_in_step() -> None:
    """One that does not see them is named; pulses that do not show, by where the line stands."""
    sound = talk(f"{SOUND}&sync_wire=data")
    assert checks(sound)["nodes"] == [
        Check(Grade.OK, "nodes", "16 of 16 spoke, in step with pulses on the data wire")
    ]
    (deaf,) = checks(talk(f"{WITHOUT_5}&sync_wire=data"))["nodes"]
    assert "15 of 16 spoke" in deaf.text and "not heard: node 5" in deaf.text
    assert "do they get sync pulses?" in deaf.text

    for level, cause in ((-2048, "stuck at"), (1900, "stuck at"), (0, "transistor at GPIO16")):
        assert cause in said_of_sync(sound, np.full(1 << 14, level), 39)
        assert not said_of_sync(sound, np.full(1 << 14, level), 0)


def test_hum_is_no_pulse() -> None:
    """It moves the line as far as one would, but the digitizer saw its pulses."""
    hum = 1900 * np.sin(np.arange(1 << 14) * 2 * np.pi * 50 / 80e3)
    assert not said_of_sync(talk(f"{SOUND}&sync_wire=data"), hum, 0)


def said_of_sync(packets: list[Packet], line: np.ndarray, faults: int) -> str:
    """What is said of pulses: packets have these samples, the last STATUS so many faults more."""
    edited = changed(packets, lambda counts, _: line[: counts.size])
    edited += [Status(10**6), Status(2 * 10**6, sync_faults=faults)]
    found = judge(stream_of(edited), SkinConfig.of({}), SECONDS, "no frames")
    return "".join(check.text for check in found if check.subject == "sync")


SKINS: dict[str, dict[str, Value]] = {
    "raw": {},
    "chip means": {"samples_per_chip": 1},
    "no frame marks": {"timing": GAP},
    "unipolar": {"drive": UNIPOLAR},
    "inverted": {"polarity": -1, "parity": True},
    "one node": {"nodes": 1},
    "the paper's code": {"order": 16, "first_row": 0, "sign_seed": -1},
    "36 nodes": {"nodes": 36, "frame_period_ms": 25.0},
}


@settings(max_examples=24)
@given(
    kind=st.sampled_from(sorted(SKINS)),
    scene=st.sampled_from([*SCENES, *LOADS]),
    amplitude_mv=st.floats(5.0, 3000.0),
    stated=st.floats(0.85, 1.15),
    always=st.booleans(),
    named=st.booleans(),
    more=st.sampled_from(["", "offset=0.2", "stretch=0.1", "sensor=paper", "mismatch=0.05"]),
    seed=st.integers(0, 99),
)
@example("raw", "idle", 280.0, 300 / 280, False, False, "", 0)
@example("raw", "press", 280.0, 300 / 280, False, False, "", 0)
@example("no frame marks", "demo", 300.0, 1.0, False, False, "", 79)
@example("chip means", "presses", 185.0, 1.0, False, False, "", 17)
def test_nothing_is_wrong_with_a_sound_skin(
    kind: str,
    scene: str,
    amplitude_mv: float,
    stated: float,
    always: bool,
    named: bool,
    more: str,
    seed: int,
) -> None:
    """Of any amplitude, before a digitizer that a driver has set by another one.

    stated: the amplitude in its parameters over the true one. named: the doctor knows them. always:
    all nodes speak in every frame. more: options of the simulator.
    """
    assume(kind != "chip means" or "stretch" not in more)  # means of other chips than the nodes'
    parameters = {**SKINS[kind], "amplitude_mv": stated * amplitude_mv}
    config = SkinConfig.of(parameters)
    url = f"sim://?scene={scene}&amplitude_mv={amplitude_mv!r}&noise={amplitude_mv / 6e4!r}&{more}"
    packets = packets_of(f"{url}&threshold={int(not always)}&heartbeat=20&seed={seed}", config)
    found = checks(packets, **{**parameters, "amplitude_mv": parameters["amplitude_mv"] * named})
    wrong = [c for about in found.values() for c in about if c.verdict is not Grade.OK]
    assert not wrong
    nodes = config.spec.nodes
    assert found["nodes"][0].text == f"{nodes} of {nodes} spoke"


@pytest.mark.parametrize("line", ["rail=1", "noise=2"])
def test_a_line_on_which_no_word_is_clear_is_not_called_unpowered(line: str) -> None:
    found = checks(packets_of(f"sim://?scene=all&threshold=0&{line}&seed=3"))
    told = [check for about in found.values() for check in about]
    assert any(check.verdict is not Grade.OK for check in told)
    assert not any("powered" in check.text for check in told)


def test_frames_that_waited_do_not_come_faster_than_they_were_sent() -> None:
    chunks = stream_of(packets_of(ALL_TALK))
    late_s = chunks[len(chunks) // 2][1]
    found = judged([(data, max(t_host, late_s)) for data, t_host in chunks])
    assert found["frames"].text == "78.1 of 78.1 per s, 0 lost"


@pytest.mark.parametrize(("share", "why"), [(0.72, "too large, or a joint"), (1.3, "too small")])
def test_a_node_with_another_resistor_is_named(share: float, why: str) -> None:
    [told] = checks(with_node(talk(WITHOUT_5), talk(ONLY_5), share))["loudness"]
    assert told.text.startswith("node 5 is") and why in told.text
    assert float(told.text.split()[3]) == pytest.approx(share, rel=0.05)


@pytest.mark.parametrize(
    ("share", "verdict", "why"),
    [
        (0.97, Grade.OK, "97.0%"),
        (0.9, Grade.WARNING, "low, or a bad joint of it"),
        (1.1, Grade.WARNING, "a bad joint of ground"),
        (5 / 3.3, Grade.OK, "151.5%"),
    ],
)
@pytest.mark.parametrize("polarity", [1, -1])
def test_another_supply_is_told(share: float, verdict: Grade, why: str, polarity: int) -> None:
    """16 pins that speak move the line by 16 levels' share of what their middle is off its rest."""
    sound = talk(f"{SOUND}&polarity={polarity}")
    shift = round(polarity * (share - 1) * 16 * 0.3 / info_of(sound).volts_per_count)
    driven_s = 200 * 50e-6  # 10 bits of 20 chips
    moved = changed(sound, lambda counts, at_s: counts + shift * (at_s < driven_s))
    [told] = checks(moved)["supply"]
    assert told.verdict is verdict and why in told.text


def test_chips_of_one_scrambled_node_are_no_supply() -> None:
    """They do not add up to nothing, as unscrambled ones do: by chance to several per cent."""
    [told] = checks(talk("scramble=true&dead=2,3,4,5,6,7,8,9,10,11,12,13,14,15,16"))["supply"]
    [percent] = map(float, re.findall(r"at ([\d.]+)% of", told.text))
    assert told.verdict is Grade.OK and percent == pytest.approx(100.0, abs=0.3)


def with_crosstalk(packets: list[Packet], step_v: float, lasts_s: float) -> list[Packet]:
    """The same line beside a sync wire, whose pulses begin 64 µs before a frame and take 32 µs."""
    info = info_of(packets)
    period_s = info.frame.frame_period_us * 1e-6

    def beside(counts: np.ndarray, at_s: np.ndarray) -> np.ndarray:
        volts = np.zeros(at_s.size)
        for edge_s, sign in ((64e-6, 1), (32e-6, -1)):
            since_s = at_s - (period_s - edge_s)
            decay = np.exp(-np.maximum(since_s, 0) / lasts_s)
            volts += np.where(since_s >= 0, sign * step_v * decay, 0.0)
        return counts + volts / info.volts_per_count

    return changed(packets, beside)


@pytest.mark.parametrize(
    ("step_v", "lasts_s", "verdict", "said"),
    [
        (0.0, 1e-6, Grade.OK, "sync edges move the line by"),
        (0.2, 2e-6, Grade.OK, "sync edges move the line by"),
        (3.0, 3e-6, Grade.WARNING, "mV: lay a ground wire between sync and line"),
        (0.3, 60e-6, Grade.WARNING, "still when the frame begins"),
    ],
)
def test_crosstalk_is_told(step_v: float, lasts_s: float, verdict: Grade, said: str) -> None:
    """Of nodes of 0.3 V: a part of one that is over soon is as on the boards, more is not."""
    [told] = checks(with_crosstalk(talk(SOUND), step_v, lasts_s))["crosstalk"]
    assert told.verdict is verdict and said in told.text


@pytest.mark.parametrize(
    ("level_v", "verdict", "why"),
    [
        (0.1, Grade.OK, "V, should be"),
        (-0.5, Grade.PROBLEM, "one of the two equal resistors"),
        (3.0, Grade.PROBLEM, "one of the two equal resistors"),
        (-6.0, Grade.PROBLEM, "a short to ground, line and sync swapped"),
        (6.0, Grade.PROBLEM, "a short to supply"),
    ],
)
def test_where_the_line_rests_is_told(level_v: float, verdict: Grade, why: str) -> None:
    """Shifted as a whole, and held by the converter's range, which is ±5.3 V here."""
    info = info_of(talk(SOUND))
    shift = round(level_v / info.volts_per_count)
    least, most = info.min_count, info.max_count
    moved = changed(talk(SOUND), lambda counts, _: np.clip(counts + shift, least, most))
    [told] = checks(moved, "no frames")["rest"]
    assert told.verdict is verdict and why in told.text


def turned_over(packets: list[Packet]) -> list[Packet]:
    """The same line upside down."""
    zero = info_of(packets).zero_count
    return changed(packets, lambda counts, _: 2 * zero - counts)


def node_5(share: float, url: str = ALL_TALK, beside: str = WITHOUT_5) -> list[Packet]:
    """A skin on which node 5, which another digitizer heard, is so much of itself."""
    return with_node(packets_of(f"{url}&{beside}"), packets_of(f"{url}&{ONLY_5}"), share)


def loose_joint() -> list[Packet]:
    """Node 5 loses a third of its level for a tenth of a second, again and again."""
    whole, loose = node_5(1.0), node_5(0.65)
    return [
        weak if isinstance(packet, Samples) and packet.device_time_us // 100_000 % 2 else packet
        for packet, weak in zip(whole, loose, strict=True)
    ]


def seen(
    options: str, asked: dict[str, Any] | None = None, turned: bool = False
) -> Callable[[], list[Packet]]:
    """asked: how a driver has set the digitizer before. turned: the line is upside down."""
    config = None if asked is None else SkinConfig.of(asked)
    upside = turned_over if turned else list[Packet]
    return lambda: upside(packets_of(f"sim://?{options}", config))


DEAD, FSR = "dead=" + ",".join(str(node) for node in range(1, 17)), "threshold=0&sensor=fsr"
ALL, FEW = "scene=press&threshold=0&noise=0.01", "sim://?scene=idle&heartbeat=20"
REST, FAINT = "sim://?scene=idle&threshold=0&noise=0.01", "amplitude_mv=20&heartbeat=20"
PARITY, STRONG, UNKNOWN = {"parity": True}, {"amplitude_mv": 300.0}, {"amplitude_mv": 0.0}
ROW_0 = {"order": 16, "first_row": 0, "samples_per_chip": 1}
RISING = {"v0_v": 0.0, "sensitivity1_v_per_kpa": -0.033, "sensitivity2_v_per_kpa": -0.0059}
ALONE = {"polarity": -1, "sync_wire": "data", "scramble": True, "amplitude_mv": 97.06}
TURN, NEGATE = "polarity .*set polarity to -1", r"polarity .*negative sensitivities .sensitivity1_v"
ONE_OR_ANOTHER = "nodes problem: .*two nodes speak on one code row: node 5;"
HIDDEN = "quiet warning: .*differ by less than 81 mV", "nodes (warning|problem): "
FAULTS: list[tuple[Any, ...]] = [
    (lambda: talk(WITHOUT_5), {}, "nodes warning: .*15 of 16 spoke, not heard: node 5:.* 1.2 list"),
    # Of one value per chip, row 0 alone holds the line's level.
    (seen("scene=all&dead=1&offset=0.3", ROW_0), ROW_0, "nodes warning: .*not heard: node 1"),
    # Nodes of 20 mV hide where samples are sent only if they differ by 81 mV, even if many speak.
    (seen(f"scene=idle&{FAINT}", STRONG), UNKNOWN, *HIDDEN),
    (seen(f"scene=press&{FAINT}", STRONG), UNKNOWN, *HIDDEN),
    (seen("scene=idle&heartbeat=0&noise=0.01", {"samples_per_chip": 1} | UNKNOWN), {},
     "frames ok: 78.1 of 78.1 per s, 0 lost", "nodes .*no node speaks: power, sync pulses"),
    (lambda: node_5(0.4), {}, "nodes ok: 16 of 16 spoke",
     "nodes warning: .*weaker on the line than they should be: node 5;"),
    (loose_joint, {}, "joint warning: node 5 comes and goes.*a cold joint"),
    # At rest it reads ground, where others read the supply: all bits of its word are inverted.
    (lambda: node_5(1.0, REST), {}, "no sensors"),
    (lambda: node_5(-1.0, REST), {}, "no polarity",
     "sensors .*in every word, as none that is pressed: node 5: sensor and its resistor"),
    (lambda: node_5(1.0, beside="seed=1&dead=6"), {}, ONE_OR_ANOTHER,
     "nodes .*not heard: node 6: was one flashed with the number of node 5"),
    (lambda: node_5(0.9, beside=SOUND), {}, ONE_OR_ANOTHER),
    (lambda: node_5(1.0, beside=SOUND), {}, ONE_OR_ANOTHER),
    (lambda: node_5(1.0, FEW, SOUND), {}, ONE_OR_ANOTHER),
    (seen(f"{ALL}&{DEAD}"), {}, "nodes problem: .*no node speaks"),
    # As long as no amplitude is known, noise has some frames in doubt: that says nothing.
    (seen(f"scene=idle&noise=0.005&seed=1&{DEAD}", ALONE), ALONE, "nodes .*quickly: wrong clock.$"),
    (seen("scene=all&threshold=0&rail=1.2"), {}, "range problem: ", "no amplitude_mv"),
    (seen(f"{ALL}&drive=unipolar"), {}, "amplitude_mv ok: ", "no polarity"),
    *((lambda: talk(SOUND), {"amplitude_mv": stated},
       f"amplitude_mv {said}: (?=.*{stated}).*(299|30[01])") for stated, said in
      ((300, "ok"), (260, "ok"), (212, "warning"), (900, "problem"))),
    *((seen(f"scene={scene}"), {}, "no polarity")
      for scene in ("idle", "hand&threshold=0", "all&threshold=0", "press", "moving")),
    (seen("scene=press&seed=1", turned=True), {}, f"polarity problem: {TURN[9:]}"),
    (seen("scene=moving&seed=1", turned=True), {}, f"polarity problem: {TURN[9:]}"),
    # Of 11 bits with parity a word that is turned over is none; without, a person has to tell.
    (seen(f"scene=idle&{FSR}", PARITY), PARITY, NEGATE, f"(?!{TURN})polarity"),
    (seen(f"scene=press&{FSR}", PARITY), PARITY, NEGATE, f"(?!{TURN})polarity"),
    (seen("scene=press&threshold=0", PARITY, True), PARITY, TURN, f"(?!{NEGATE})polarity"),
    (seen(f"scene=idle&{FSR}", {}), {}, NEGATE, TURN),
    (seen(f"scene=press&{FSR}", {}), {}, NEGATE, TURN),
    (seen("scene=press&threshold=0", {}, True), {}, NEGATE, TURN),
    *((seen(f"scene={scene}&{FSR}"), RISING, "no polarity") for scene in ("idle", "press", "all")),
    (seen("scene=idle&threshold=0"), RISING, "polarity .*positive sensitivities"),
]  # fmt: skip
"""What a skin sends, the parameters that it is examined by, and lines of what is said of it."""


@pytest.mark.parametrize("fault", FAULTS, ids=[fault[-1] for fault in FAULTS])
def test_what_is_wrong_is_told_and_nothing_else(fault: tuple[Any, ...]) -> None:
    packets, values, *lines = fault
    found = [check for about in checks(packets(), **values).values() for check in about]
    told = "\n".join(f"{each.subject} {each.verdict}: {each.text}" for each in found)
    for line in lines:
        is_there = bool(re.search(f"^{line.removeprefix('no ')}", told, re.MULTILINE))
        assert is_there != line.startswith("no "), told


def test_lost_packets_broken_bytes_and_none_are_told() -> None:
    found = judged([c for i, c in enumerate(stream_of(talk(SOUND))) if i % 20 != 19])
    assert found["link"].verdict is Grade.WARNING
    assert found["frames"].verdict is Grade.WARNING
    chunks = stream_of(talk(SOUND))
    found = judged(
        [(b[:9] + b"\x55" + b[10:] if i % 30 == 29 else b, t) for i, (b, t) in enumerate(chunks)]
    )
    assert found["link"].verdict is Grade.WARNING
    assert "0 broken" not in found["link"].text
    with pytest.raises(PortError):
        judged([(b"\0abc\0", 1.0)])


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-5, 1e-4, 1e-3, 0.1]))
def test_whatever_comes_there_is_a_verdict_or_a_reason(seed: int, share: float) -> None:
    rng, chunks = np.random.default_rng(seed), stream_of(talk(SOUND))
    data = np.frombuffer(b"".join(chunk for chunk, _ in chunks), np.uint8).copy()
    data = data[: rng.integers(1, len(data))]
    hit = rng.random(len(data)) < share
    data[hit] = rng.integers(0, 256, np.count_nonzero(hit))
    parts = np.array_split(data, 50)
    with suppress(PortError):
        assert "link" in judged([(part.tobytes(), 0.01 * i) for i, part in enumerate(parts)])
