# SPDX-License-Identifier: Apache-2.0

"""Sync pulses on the data wire, and nodes that scramble otherwise than the parameters say."""

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.encode import line_chips
from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.doctor.port import examine
from tactile_cdma.driver import checkup
from tactile_cdma.driver.checkup import Level
from tactile_cdma.driver.digitizer import contradiction, sync_trouble
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.scrambling import ScrambleWatch, mismatch
from tactile_cdma.driver.session import Session
from tactile_cdma.driver.vitals import Vitals
from tactile_cdma.readings.status import is_certain
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.protocol_sim import Serial
from tactile_cdma.wire._protocol import SyncMode, SyncWire
from tactile_cdma.wire.messages import Configure, FrameLayout, Info, Packet, Quiet, Samples, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support import lost_frames
from test.support.simulated import OtherwiseScrambled, told
from test.support.waiting import wait_for

ONE_WIRE: dict[str, Value] = {"sync_wire": "data"}
CONFIG = SkinConfig.of({**ONE_WIRE, "nodes": 16, "frame_period_ms": 11.2})
"""Its gap is 1.2 ms, of which pulses of a turn and their 64 µs each may take a third."""
SPEC, RATE_HZ, COUNT_V, SIGMA_V = CONFIG.spec, 80e3, 1e-4, 5e-3
INFO = Info(
    frame=FrameLayout.of(SPEC, 4),
    sample_rate_uhz=round(RATE_HZ * 1e6),
    volts_per_count=COUNT_V,
    min_count=-32768,
    max_count=32767,
    sync_mode=SyncMode.DRIVE,
    sync_wire=SyncWire.DATA,
)
PERIOD, SPAN = round(SPEC.frame_period_s * RATE_HZ), 4 * SPEC.span_chips


def edges_us(turn: int, asked: bool) -> list[int]:
    """Edges of the pulses before a frame, µs before it, as docs/protocol.md has them."""
    digits = [digit for digit in range(5) if turn >> digit & 1] + [5] * asked
    return [64 + 128 * (digit + 1) for digit in digits] + [64]


def held(volts: np.ndarray, turn: int, asked: bool) -> np.ndarray:
    """Return a period's samples as the digitizer holds them: of each pulse 64 µs."""
    t_us = 1e6 * (np.arange(PERIOD) + 0.5 - PERIOD) / RATE_HZ
    for edge_us in edges_us(turn, asked):
        inside = np.flatnonzero((t_us >= -edge_us) & (t_us < 64 - edge_us))
        volts[inside] = volts[inside[0] - 1]
    return volts


def gap_noise_v(frames: int, turn: int, asked: bool, quiet: bool) -> float:
    """Return what the driver takes for the noise of a chip, from gaps: the RMS of its estimates.

    Node 3 speaks. quiet: gaps are sums.
    """
    rng, pipeline, writer = np.random.default_rng(turn), Pipeline(CONFIG), PacketWriter()
    chips = line_chips(SPEC, np.full(16, 600), np.arange(16) == 2)
    pipeline.feed(writer.encode(INFO), 0.0)
    squares, end = [], SPAN + 12
    for number in range(frames):
        volts = SIGMA_V * rng.standard_normal(PERIOD)
        volts[:SPAN] += np.repeat(chips.ravel(), 4)
        counts = np.rint(held(volts, turn, asked) / COUNT_V).astype(np.int16)
        index, us = number * PERIOD, 1e6 + number * PERIOD / RATE_HZ * 1e6
        mark = Samples(round(us), index, counts[:end], sync=True, turn=turn, asked=asked)
        make = Quiet.of if quiet else Samples
        gap = make(round(us + end / RATE_HZ * 1e6), index + end, counts[end:])
        frame = pipeline.feed(writer.encode(mark), 0.0)[-1]
        pipeline.feed(writer.encode(gap), 0.0)
        assert frame.words.codes[2] == 600 and not frame.words.doubtful[2]
        squares.append(pipeline.stream._about.rest.noise_v2)
    return float(np.sqrt(np.mean(squares[frames // 4 :])))


@pytest.mark.parametrize(
    ("turn", "asked", "quiet"),
    [(0, False, False), (2, False, False), (31, True, False), (0, False, True)],
)
def test_a_gaps_noise_is_the_lines_whatever_was_held(turn: int, asked: bool, quiet: bool) -> None:
    """A held sample is one of the line, which counts six times: that costs the mean square little.

    By arithmetic: of the 80 samples that are looked at, 6 pulses leave 50 and 6 that count k = 6
    times, so the mean square about their mean is 1 − Σk²/n² = 0.96 of the noise's. A chip is the
    mean of 4 samples.
    """
    pulses = len(edges_us(turn, asked))
    share = 1 - (80 - 6 * pulses + 36 * pulses) / 80**2
    found_v = gap_noise_v(600, turn, asked, quiet)
    assert 0.985 * np.sqrt(share) < found_v / (SIGMA_V / 2) < 1.015


def test_the_simulated_digitizer_holds_from_each_edge_to_what_it_announces() -> None:
    """Against times by hand: in noise, samples repeat there and nowhere else for so long."""
    config = SkinConfig.of({**ONE_WIRE, "nodes": 4, "resync_chips": 40, "guard_chips": 4})
    digitizer = VirtualDigitizer(SimOptions(speed=0, noise=0.02), clock=lambda: 0.0)
    digitizer.receive(Session(config).open())
    digitizer.advance(60_000)
    packets = PacketParser().feed(digitizer.take(60_000))
    (info, *_) = [packet for packet in packets if isinstance(packet, Info) and packet.sync_wire]
    samples = [packet for packet in packets if isinstance(packet, Samples)]
    counts = np.concatenate([packet.counts for packet in samples])
    t_us = 1e6 * (np.arange(counts.size) + 0.5) / info.sample_rate_hz
    spec = config.spec
    period_us, slot_us = 1e6 * spec.frame_period_s, 44 * 50
    ends_us = [period_us * frame + slot_us * slot for frame in range(9) for slot in range(2)]
    assert spec.chips == 80 and [p.sync for p in samples[:1]] == [True]
    expected = np.zeros(counts.size, bool)
    for end_us in ends_us[1:]:
        expected |= (t_us >= end_us - 64) & (t_us < end_us)
    repeats = np.append(False, counts[1:] == counts[:-1])
    assert repeats[expected].all() and expected.sum() >= 5 * 10
    assert repeats[~expected].mean() < 0.2  # by chance


def test_words_are_those_of_a_sync_wire_and_all_are_certain() -> None:
    values: dict[str, Value] = {"nodes": 16}
    found = []
    for wire in ("own", "data"):
        config = SkinConfig.of({**values, "sync_wire": wire})
        digitizer = VirtualDigitizer(SimOptions(speed=0, threshold=0), clock=lambda: 0.0)
        digitizer.receive(Session(config).open())
        digitizer.advance(300_000)
        frames = Pipeline(config).feed(digitizer.take(300_000), 0.0)
        assert not any(frame.words.doubtful.any() for frame in frames)
        found.append([frame.words.codes.tolist() for frame in frames])
    assert found[0] == found[1] and len(found[0]) > 100


def asked_by(config: SkinConfig) -> Configure:
    """What a driver asks of its digitizer."""
    [configure, *_] = PacketParser().feed(Session(config).open())
    assert isinstance(configure, Configure)
    return configure


def test_the_digitizer_is_asked_for_the_wire_and_another_answer_is_named() -> None:
    own = SkinConfig.of({"nodes": 16, "frame_period_ms": 11.2})
    wires = [asked_by(config).sync_wire for config in (own, CONFIG)]
    assert wires == [SyncWire.OWN, SyncWire.DATA]
    assert contradiction(INFO, CONFIG) is None
    wrong = contradiction(INFO, own)
    assert wrong and "sync_wire data (parameters: own)" in wrong
    wrong = contradiction(replace(INFO, sync_wire=SyncWire.OWN), CONFIG)
    assert wrong and "sync_wire own (parameters: data)" in wrong


def test_who_hears_another_digitizer_is_asked_to_and_what_it_misses_is_named() -> None:
    values: dict[str, Value] = {"nodes": 16, "frame_period_ms": 11.2}
    alone, hearing = (SkinConfig.of({**values, "sync": sync}) for sync in ("drive", "hear"))
    modes = [asked_by(config).sync_mode for config in (alone, hearing)]
    assert modes == [SyncMode.DRIVE, SyncMode.HEAR]
    deaf = replace(INFO, sync_wire=SyncWire.OWN)
    hears = replace(deaf, sync_mode=SyncMode.HEAR)
    assert contradiction(deaf, alone) is contradiction(hears, hearing) is None
    wrong = contradiction(deaf, hearing)
    assert wrong and "follows no other one's frames" in wrong
    assert sync_trouble(deaf, 1.65) is None
    for info in (hears, replace(hears, sync_wire=SyncWire.DATA)):
        trouble = sync_trouble(info, 1.65)
        assert trouble and "GPIO17" in trouble


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"timing": "gap"}, "timing 'gap' wants quiet gaps"),
        ({"chip_us": 34.0}, "chip_us 34; it must be 35 or more"),
        ({"frame_period_ms": 10.9}, "frame_period_ms 10.9; it must be 11 or more"),
        ({"node_kind": "fast", "rate_hz": 50.0}, "atmega328p-fast hears sync pulses only"),
    ],
)
def test_what_the_wire_does_not_go_with_is_refused(values: dict[str, Value], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        SkinConfig.of({**ONE_WIRE, **values})


def test_periods_and_rates_are_chosen_for_the_data_wire() -> None:
    """3 chips of 100 µs after a frame, and 832 µs of pulses: more than nodes take to measure."""
    spec = SkinConfig.of({**ONE_WIRE, "chip_us": 100.0}).spec
    assert spec.frame_period_s == pytest.approx(spec.frame_s + 1.2e-3)
    assert SkinConfig.of({"chip_us": 100.0}).spec.frame_period_s == pytest.approx(21e-3)
    # 64 nodes at 30 Hz take chips below 50 µs; at 60 Hz only fast nodes would do.
    slow = SkinConfig.of({**ONE_WIRE, "nodes": 64, "rate_hz": 30.0})
    assert slow.node_kind == "slow" and slow.spec.chip_s >= 35e-6
    assert SkinConfig.of({"nodes": 64, "rate_hz": 60.0}).node_kind == "fast"
    with pytest.raises(SpecError, match="rate_hz is 60"):
        SkinConfig.of({**ONE_WIRE, "nodes": 64, "rate_hz": 60.0})


STUCK_V = 0.119
"""A pulled line, by SPICE: 34 kΩ, an amplifier with Rf 2 kΩ, 47 Ω and a transistor."""
BOARD = replace(
    INFO, volts_per_count=3.3 / 4096, min_count=0, max_count=4095, zero_count=0, quiet_uv=13_500
)
"""A digitizer whose line rests at 1.65 V."""


def line_at(level_v: float, first: int, frames: int) -> Iterator[Packet]:
    """Yield what a board sends while its line stands at a level, from a frame on."""
    gap, count = SPAN + 12, round(level_v / BOARD.volts_per_count)
    counts = np.full(PERIOD, count, np.int16)
    for frame in range(first, first + frames):
        us, index = 1_000_000 + 11_200 * frame, frame * PERIOD
        yield Quiet.of(us, index, counts[:gap], sync=True)
        yield Quiet.of(us + round(gap / RATE_HZ * 1e6), index + gap, counts[gap:])


@pytest.mark.parametrize(
    ("level_v", "cause"),
    [
        (STUCK_V, "stuck at 0.12 V"),
        (3.24, "stuck at 3.24 V"),  # behind an amplifier that inverts
        (1.65, "is the transistor at GPIO16 connected, is another digitizer"),
    ],
)
def test_pulses_that_do_not_show_are_named_and_silence_unknown(level_v: float, cause: str) -> None:
    """Within a second, by the STATUS in it: whoever heard no pulse was silent, whatever it felt."""
    config = SkinConfig.of({**ONE_WIRE, "frame_period_ms": 11.2, "amplitude_mv": 50.0})
    pipeline, writer = Pipeline(config), PacketWriter()

    def take(*packets: Packet) -> list[TactileFrame]:
        return [frame for p in packets for frame in pipeline.feed(writer.encode(p), 0.0)]

    chips = line_chips(SPEC, np.full(16, 900), amplitude_v=0.05)
    volts = np.append(1.65 + np.repeat(chips.ravel(), 4), np.full(PERIOD - SPAN, 1.65))
    said = np.rint(volts / BOARD.volts_per_count).astype(np.int16)
    take(BOARD, Status(0, streaming=True), Samples(1_000_000, 0, said, sync=True))
    *_, sound = take(*line_at(1.65, 1, 40), Status(1_400_000, streaming=True))
    assert is_certain(sound.readings.status).all()
    vitals = Vitals()
    vitals.take(pipeline)
    take(*line_at(level_v, 41, 40), Status(2_000_000, sync_faults=40, streaming=True))
    (finding,) = [f for f in checkup.link(pipeline, vitals.take(pipeline)) if cause in f.text]
    assert finding.event
    *_, blind = take(*line_at(level_v, 81, 2))
    assert not is_certain(blind.readings.status).any()


SCRAMBLED = "the nodes scramble their chips, but scramble is false: set scramble to true"
PLAIN = "the nodes do not scramble their chips, but scramble is true: write their memories anew"
SAID = pytest.mark.parametrize(("scramble", "said"), [(False, SCRAMBLED), (True, PLAIN)])
"""By the parameter, of which nodes do the opposite."""
SKINS: list[tuple[str, dict[str, Value]]] = [
    ("scene=all&threshold=0", {}),
    ("scene=press", {}),
    ("scene=idle", {}),
    ("scene=idle", {"nodes": 1, "order": 20}),
    ("scene=press", {"nodes": 2, "order": 4}),
    ("scene=press", {"nodes": 64, "frame_period_ms": 40.0, "samples_per_chip": 1}),
    ("scene=all&threshold=0", lost_frames.SKINS["900"]),
    ("scene=press", {"timing": "gap"}),
    ("scene=press&amplitude_mv=150", {}),
]
"""Many speakers, few, and one a second; one value per chip; another amplitude than is stated."""


def chunks_of(
    kind: type[VirtualDigitizer], config: SkinConfig, options: str, seconds: float
) -> Iterator[tuple[bytes, float]]:
    """What a host reads of a digitizer that it sets up by these parameters, and when."""
    return told(SimOptions.from_url(f"sim://?{options}"), seconds, config, kind)


@SAID
@pytest.mark.parametrize(("options", "values"), SKINS)
def test_the_other_way_is_found(
    options: str, values: dict[str, Value], scramble: bool, said: str
) -> None:
    config = SkinConfig.of({**values, "scramble": scramble})
    found = mismatch(config, chunks_of(OtherwiseScrambled, config, options, 5.0))
    assert found is not None and found.startswith(said)


@pytest.mark.parametrize("scramble", [False, True])
@pytest.mark.parametrize(("options", "values"), SKINS)
def test_obedient_nodes_are_not_accused(
    options: str, values: dict[str, Value], scramble: bool
) -> None:
    config = SkinConfig.of({**values, "scramble": scramble})
    chunks = [*chunks_of(VirtualDigitizer, config, options, 3.0)]
    assert mismatch(config, chunks) is None
    pipeline, watch = Pipeline(config), ScrambleWatch(config)
    for data, t_host in chunks:
        for frame in pipeline.feed(data, t_host):
            watch.hear(frame)
        assert not watch.look(pipeline) and not watch.listens
    assert watch.is_over


@pytest.mark.parametrize("scramble", [False, True])
@pytest.mark.parametrize(
    ("options", "values"),
    [
        ("scene=idle&heartbeat=0&noise=0.1", {}),  # nobody speaks
        ("scene=all&threshold=0&noise=3", {}),  # nobody is heard
        ("scene=all&threshold=0", {"drive": "unipolar"}),
        ("scene=press", {"nodes": 9, "order": 16, "codes": "sparse", "samples_per_chip": 1}),
    ],
)
def test_no_words_are_no_mismatch(options: str, values: dict[str, Value], scramble: bool) -> None:
    given = {**values, "scramble": scramble and "drive" not in values}
    config = SkinConfig.of(given)
    assert mismatch(config, chunks_of(VirtualDigitizer, config, options, 3.0)) is None


@pytest.fixture
def otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes behind sim:// scramble if the driver does not, and the reverse."""

    def made(self: Serial, url: str) -> VirtualDigitizer:
        return OtherwiseScrambled(SimOptions.from_url(url, self.layout))

    monkeypatch.setattr(Serial, "_made", made)


@SAID
@pytest.mark.parametrize("scene", ["all&threshold=0", "press"])
def test_the_driver_tells(
    otherwise: None, caplog: pytest.LogCaptureFixture, scene: str, scramble: bool, said: str
) -> None:
    """In the log, in /diagnostics, and as the problem where there is no frame at all."""
    frames: list[TactileFrame] = []
    problems: list[str | None] = []
    config = SkinConfig.of({"scramble": scramble})
    with (
        caplog.at_level(logging.ERROR),
        Driver(config, f"sim://?scene={scene}", 9600, frames.append, problems.append) as driver,
    ):
        wait_for(lambda: driver.scrambling.problem)
        told = driver.scrambling.problem
        with driver.between_frames() as pipeline:
            window = driver.vitals.take(pipeline)
            [finding] = checkup.nodes(pipeline, [], window, driver.scrambling.problem)
        if not frames:
            wait_for(lambda: any(said in (problem or "") for problem in problems))
    assert (finding.text, finding.level) == (told, Level.ERROR)
    assert said in finding.text and said in caplog.text
    assert caplog.text.count(said) == 1
    assert not any((frame.words.active & ~frame.words.doubtful).any() for frame in frames)


@SAID
@pytest.mark.parametrize("scene", ["all&threshold=0", "press"])
def test_the_doctor_tells(
    otherwise: None, tmp_path: Path, scene: str, scramble: bool, said: str
) -> None:
    params = tmp_path / "skin.yaml"
    params.write_text(f"/**: {{ros__parameters: {{scramble: {str(scramble).lower()}}}}}")
    found = [*examine(f"sim://?scene={scene}", params, None, 2.0)]
    [wrong] = [check for check in found if check.verdict == "problem"]
    assert wrong.subject == "scramble" and wrong.text.startswith(said)


def test_it_listens_again_later_and_ever_more_seldom() -> None:
    """A line of noise costs a look, and then another after ten times as many frames."""
    config = SkinConfig.of({"samples_per_chip": 1})
    pipeline, watch, began = Pipeline(config), ScrambleWatch(config), []
    options = "scene=all&threshold=0&noise=1"
    for data, t_host in chunks_of(VirtualDigitizer, config, options, 20.0):
        listened = watch.listens
        if listened:
            watch.note(data, t_host)
        for frame in pipeline.feed(data, t_host):
            watch.hear(frame)
        assert not watch.look(pipeline)
        if watch.listens and not listened:
            began.append(t_host)
    assert len(began) == 2 and began[1] > 5 * began[0]
