# SPDX-License-Identifier: Apache-2.0

"""The doctor's findings in a stream; each fault is produced by changing the bytes on the line."""

from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import zip_longest

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tactile_cdma.base.errors import PortError
from tactile_cdma.code.frame import UNIPOLAR
from tactile_cdma.config.parameters import GAP, Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.doctor.report import Check, Grade
from tactile_cdma.doctor.stream import Chunks, judge
from tactile_cdma.driver.session import Session
from tactile_cdma.recording.offline import parameters_of
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import LOADS, SCENES
from tactile_cdma.wire.messages import Info, Packet, Quiet, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter

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


def checks(packets: list[Packet], **values: object) -> dict[str, list[Check]]:
    """By subject; values: parameters that are not as the digitizer says."""
    info = [packet for packet in packets if isinstance(packet, Info)][-1]
    config = SkinConfig.of({**parameters_of(info), "amplitude_mv": 300.0, **values})  # type: ignore[dict-item]
    found: dict[str, list[Check]] = {}
    for check in judge(stream_of(packets), config, SECONDS):
        found.setdefault(check.subject, []).append(check)
    return found


def judged(chunks: Chunks) -> dict[str, Check]:
    """By subject, what is said of bytes and the times when they were read."""
    return {check.subject: check for check in judge(chunks, SkinConfig.of({}), SECONDS)}


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


def test_an_offset_is_not_counted_as_the_dead_node_on_row_0() -> None:
    """Of one value per chip, row 0 alone holds the line's level."""
    row_0 = {"order": 16, "first_row": 0, "samples_per_chip": 1}
    dead = packets_of("sim://?scene=all&dead=1&offset=0.3", SkinConfig.of(row_0))
    [nodes] = checks(dead, **row_0)["nodes"]
    assert nodes.verdict is Grade.WARNING
    assert "15 of 16 spoke, not heard: node 1" in nodes.text


def test_what_the_digitizer_leaves_out_is_told() -> None:
    """Nodes of 20 mV hide where samples are sent only if they differ by 81 mV."""
    strong = SkinConfig.of({"amplitude_mv": 300.0})
    for scene in ("idle", "press"):  # nodes that speak together are sent
        hidden = packets_of(f"sim://?scene={scene}&amplitude_mv=20&heartbeat=20", strong)
        found = checks(hidden, amplitude_mv=0.0)
        assert found["nodes"][0].verdict is not Grade.OK
        assert found["quiet"][0].verdict is Grade.WARNING
        assert "differs by less than 81 mV" in found["quiet"][0].text


@pytest.mark.parametrize("line", ["rail=1", "noise=2"])
def test_a_line_on_which_no_word_is_clear_is_not_called_unpowered(line: str) -> None:
    found = checks(packets_of(f"sim://?scene=all&threshold=0&{line}&seed=3"))
    told = [check for about in found.values() for check in about]
    assert any(check.verdict is not Grade.OK for check in told)
    assert not any("powered" in check.text for check in told)


def test_a_node_that_says_nothing_is_named() -> None:
    [nodes] = checks(talk(WITHOUT_5))["nodes"]
    assert nodes.verdict is Grade.WARNING
    assert "15 of 16 spoke, not heard: node 5:" in nodes.text
    assert f"--seconds {2 * SECONDS:g} listens longer" in nodes.text


def test_silence_in_one_value_per_chip_is_told_by_the_stated_amplitude() -> None:
    asked = SkinConfig.of({"samples_per_chip": 1, "amplitude_mv": 0.0})
    found = checks(packets_of("sim://?scene=idle&heartbeat=0&noise=0.01", asked))
    assert found["frames"][0].text == "78.1 of 78.1 per s, 0 lost"
    powered = "frames arrive, but no node speaks: is the skin powered? One silent since power-up"
    assert found["nodes"][0].text.startswith(powered)


def test_frames_that_waited_do_not_come_faster_than_they_were_sent() -> None:
    chunks = stream_of(packets_of(ALL_TALK))
    late_s = chunks[len(chunks) // 2][1]
    found = judged([(data, max(t_host, late_s)) for data, t_host in chunks])
    assert found["frames"].text == "78.1 of 78.1 per s, 0 lost"


def test_a_weak_node_is_named() -> None:
    heard, weak = checks(with_node(talk(WITHOUT_5), talk(ONLY_5), 0.4))["nodes"]
    assert heard.text == "16 of 16 spoke"
    assert weak.verdict is Grade.WARNING
    assert "weaker on the line than they should be: node 5;" in weak.text


@pytest.mark.parametrize(
    ("url", "share"), [(ALL_TALK, 0.9), (ALL_TALK, 1.0), ("sim://?scene=idle&heartbeat=20", 1.0)]
)
def test_two_nodes_of_one_number_are_named_however_seldom_they_speak(
    url: str, share: float
) -> None:
    sound, node_5 = packets_of(f"{url}&{SOUND}"), packets_of(f"{url}&{ONLY_5}")
    _, doubled = checks(with_node(sound, node_5, share))["nodes"]
    assert doubled.verdict is Grade.PROBLEM
    assert "two nodes speak on one code row: node 5;" in doubled.text


@pytest.mark.parametrize(
    ("stated_mv", "verdict"),
    [(300.0, Grade.OK), (260.0, Grade.OK), (212.0, Grade.WARNING), (900.0, Grade.PROBLEM)],
)
def test_the_amplitude_is_measured(stated_mv: float, verdict: Grade) -> None:
    [amplitude] = checks(talk(SOUND), amplitude_mv=stated_mv)["amplitude_mv"]
    assert amplitude.verdict is verdict
    assert f"{stated_mv:g}" in amplitude.text
    assert "300" in amplitude.text or "299" in amplitude.text or "301" in amplitude.text


def test_half_amplitudes_of_unipolar_nodes_are_no_fault() -> None:
    found = checks(packets_of(f"{ALL_TALK}&drive=unipolar"))
    assert found["amplitude_mv"][0].verdict is Grade.OK
    assert "polarity" not in found


@pytest.mark.parametrize("scene", ["idle", "hand", "all"])
def test_no_scene_is_taken_for_a_wrong_polarity(scene: str) -> None:
    assert "polarity" not in checks(packets_of(f"sim://?scene={scene}&threshold=0"))


RISING = {"v0_v": 0.0, "sensitivity1_v_per_kpa": -0.033, "sensitivity2_v_per_kpa": -0.0059}


def turned_over(packets: list[Packet]) -> list[Packet]:
    """The same line upside down."""
    zero = next(packet.zero_count for packet in packets if isinstance(packet, Info))
    return [
        replace(p, counts=(2 * zero - p.counts).astype(np.int16)) if isinstance(p, Samples) else p
        for p in packets
    ]


@pytest.mark.parametrize("scene", ["press", "moving"])
def test_a_line_turned_upside_down_is_told(scene: str) -> None:
    packets = packets_of(f"sim://?scene={scene}&seed=1")
    assert "polarity" not in checks(packets)
    [polarity] = checks(turned_over(packets))["polarity"]
    assert polarity.verdict is Grade.PROBLEM
    assert "set polarity to -1" in polarity.text


@pytest.mark.parametrize(
    ("scene", "inverted"), [("idle", False), ("press", False), ("press", True)]
)
@pytest.mark.parametrize("parity", [False, True])
def test_sensors_whose_voltage_rises_are_told_from_a_wrong_polarity(
    scene: str, inverted: bool, parity: bool
) -> None:
    """Of 11 bits with parity a word that is turned over is none; without, a person has to tell."""
    asked, rising = f"sim://?scene={scene}&threshold=0", "&sensor=fsr" * (not inverted)
    packets = packets_of(asked + rising, SkinConfig.of({"parity": parity}))
    [polarity] = checks(turned_over(packets) if inverted else packets, parity=parity)["polarity"]
    assert ("negative sensitivities (sensitivity1_v" in polarity.text) == (
        not inverted or not parity
    )
    assert ("set polarity to -1" in polarity.text) == (inverted or not parity)


@pytest.mark.parametrize("scene", ["idle", "press", "all"])
def test_sensors_whose_voltage_rises_as_is_stated_are_sound(scene: str) -> None:
    packets = packets_of(f"sim://?scene={scene}&threshold=0&sensor=fsr")
    assert "polarity" not in checks(packets, **RISING)


def test_sensors_whose_voltage_falls_though_it_is_to_rise_are_told() -> None:
    [polarity] = checks(packets_of("sim://?scene=idle&threshold=0"), **RISING)["polarity"]
    assert "positive sensitivities" in polarity.text


def test_clipping_is_told_and_no_amplitude_is_read_from_it() -> None:
    found = checks(packets_of("sim://?scene=all&threshold=0&rail=1.2"))
    assert found["range"][0].verdict is Grade.PROBLEM
    assert "amplitude_mv" not in found


def test_lost_packets_are_told() -> None:
    found = judged([c for i, c in enumerate(stream_of(talk(SOUND))) if i % 20 != 19])
    assert found["link"].verdict is Grade.WARNING
    assert found["frames"].verdict is Grade.WARNING


def test_broken_bytes_are_told() -> None:
    chunks = stream_of(talk(SOUND))
    found = judged(
        [(b[:9] + b"\x55" + b[10:] if i % 30 == 29 else b, t) for i, (b, t) in enumerate(chunks)]
    )
    assert found["link"].verdict is Grade.WARNING
    assert "0 broken" not in found["link"].text


def test_a_dead_skin_is_told() -> None:
    dead = ",".join(str(node) for node in range(1, 17))
    [nodes] = checks(packets_of(f"{ALL_TALK}&dead={dead}"))["nodes"]
    assert nodes.verdict is Grade.PROBLEM
    assert "no node speaks" in nodes.text


def test_bytes_without_frames_are_an_error_and_no_verdict() -> None:
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
