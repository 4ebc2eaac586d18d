# SPDX-License-Identifier: Apache-2.0

"""The campaign on broken nodes and lines must find wrong results of the driver."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from test.support.damaged_frames import another_word, with_readings, with_words
from test.support.simulated import Truth
from torture.outcome import Outcome
from torture.signals import faulty_line, faulty_nodes
from torture.signals import trial as signal_trial
from torture.signals.campaign import trials
from torture.signals.trial import CHIPS, GAP, LINE, Faults, Kind, Skin

SKIN = Skin(LINE, {}, {"threshold": 0})
DEAD = Kind("dead", faulty_nodes.dead, length=80)
AT_REST = 1023
HUM = Kind("hum", line=faulty_line.hum(50, 3.0), length=10, pause=9)


def outcome(kind: Kind, skin: Skin = SKIN, frames: int = 1) -> Outcome:
    return trials(kind, [skin], frames, seed=1)


@pytest.mark.parametrize(
    ("kind", "skin"),
    [
        (DEAD, SKIN),
        (HUM, SKIN),
        (HUM, Skin(CHIPS, {"parity": True}, {"threshold": 0})),
        (Kind("at rail", line=faulty_line.at_rail, length=5, pause=9), SKIN),
        (Kind("40 dB", faulty_nodes.louder(100.0), length=40, range_v=40.0), SKIN),
    ],
)
def test_a_slice_of_the_campaign_has_no_fault(kind: Kind, skin: Skin) -> None:
    found = outcome(kind, skin)
    assert found.good, found
    assert found.times == 1


def planted(
    monkeypatch: pytest.MonkeyPatch, change: Callable[..., list[TactileFrame]], skin: Skin = SKIN
) -> Outcome:
    """What is found of a driver whose frames are changed like this; they come with its pipeline."""

    class Defective(Pipeline):
        def feed(self, data: bytes, t_host: float, backlog: bool = False) -> list[TactileFrame]:
            return change(self, super().feed(data, t_host, backlog))

    monkeypatch.setattr(signal_trial, "Pipeline", Defective)
    return outcome(HUM, skin)


def claimed(frame: TactileFrame, node: int, spoke: bool, flag: Status) -> TactileFrame:
    """A frame in which a node is claimed to have spoken, or not, with a flag or none."""
    active, codes = frame.words.active.copy(), frame.words.codes.copy()
    active[node], codes[node] = spoke, AT_REST
    status = frame.readings.status.copy()
    status[node] = flag | (0 if spoke else Status.SILENT)
    return with_readings(with_words(frame, active=active, codes=codes), status=status)


@pytest.mark.parametrize(
    ("flag", "counted"), [(Status(0), True), (Status.LOW_SNR, False), (Status.WEAK, True)]
)
@pytest.mark.parametrize("spoke", [False, True])
def test_an_invented_or_missed_word_is_wrong_unless_it_is_flagged(
    monkeypatch: pytest.MonkeyPatch, spoke: bool, flag: Status, counted: bool
) -> None:
    def change(_pipeline: Pipeline, frames: list[TactileFrame]) -> list[TactileFrame]:
        return [claimed(f, 3, spoke, flag) if 36 <= f.sequence < 40 else f for f in frames]

    # Untouched, a node speaks in every frame, or at its heartbeat: node 4 in frames 23 and 43.
    skin = Skin(LINE, {}, {"scene": "idle", "threshold": int(spoke)})
    found = planted(monkeypatch, change, skin)
    assert found.wrong_values == (4 if counted else 0)
    assert (
        "invented, not flagged" if spoke else "missed, not flagged"
    ) in found.said or not counted


def test_what_never_reached_the_converter_is_excused_until_it_has_to_be_stale(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torn = Kind("torn", line=faulty_line.torn_off)
    found = outcome(torn)
    stale_after = int(0.8 / SKIN.config.spec.frame_period_s)
    assert found.wrong_values == 0
    assert f"{16 * stale_after:,} of which too little reached the converter" in found.said
    monkeypatch.setattr(signal_trial, "DOUBT", Status.LOW_SNR | Status.FAULTY)  # no STALE
    assert outcome(torn).wrong_values == 16 * (torn.length - stale_after)


@pytest.mark.parametrize("skin", [SKIN, Skin(CHIPS, {"parity": True}), Skin(GAP, {})])
def test_what_reached_the_converter_is_known(skin: Skin) -> None:
    """All of a sound word, half of one in a supply that dips to nothing for half of the frame."""

    def halved(line: faulty_line.Span) -> NDArray[np.float32]:
        off = (line.t_s - line.t_s[0]) % 12.8e-3 >= line.frame_s / 2
        return np.where(off, np.float32(0), line.volts)

    for line, share in ((None, 1.0), (faulty_line.shorted, 0.0), (halved, 0.5)):
        faults = Faults(Kind("", line=line, length=4), skin, seed=1)
        options = SimOptions(speed=0, threshold=0)
        digitizer = VirtualDigitizer(options, disturbance=faults)
        digitizer.receive(Session(skin.config).open())
        while faults.number < 35:
            digitizer.advance()
            digitizer.take(1 << 20)
        codes = Truth(digitizer)[35].codes.tolist()
        shares = [faults.heard_share(35, node, code) for node, code in enumerate(codes)]
        assert shares == pytest.approx([share] * 16, abs=0.05)


def leaking(frame: TactileFrame) -> TactileFrame:
    return with_readings(frame, pressure_pa=np.full_like(frame.readings.pressure_pa, np.nan))


@pytest.mark.parametrize("spoil", [another_word, leaking])
def test_wrong_words_and_pressures_that_leak_are_found(
    monkeypatch: pytest.MonkeyPatch, spoil: Callable[[TactileFrame], TactileFrame]
) -> None:
    found = planted(monkeypatch, lambda _, frames: list(map(spoil, frames)))
    assert found.wrong_values > 10


def test_losses_that_nothing_tells_of_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def change(_pipeline: Pipeline, frames: list[TactileFrame]) -> list[TactileFrame]:
        kept = [frame for frame in frames if frame.sequence != 38]
        return [replace(f, sequence=f.sequence - (f.sequence > 38)) for f in kept]

    found = planted(monkeypatch, change)
    assert found.uncounted_losses == 1
    assert not found.wrong_values and not found.hangs


def test_a_driver_that_does_not_recover_or_fails_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    assert planted(monkeypatch, lambda _, frames: [f for f in frames if f.sequence < 40]).hangs == 1
    # There never are so many.
    assert planted(monkeypatch, lambda _, frames: [frames[9]]).crashes == 1


def test_a_broken_node_that_nobody_notices_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signal_trial, "BLAME", 0)
    assert outcome(DEAD).wrong_values == 1


def test_broken_nodes_say_what_they_say_they_do() -> None:
    """A turn's waveform, added to what is taken away, leaves the others' words as they are."""
    spec = SKIN.config.spec
    edges_s = np.arange(spec.span_chips + 1) * spec.chip_s
    draw = np.random.default_rng(1)
    turn = faulty_nodes.Turn(spec, 4, 7, 0b1011001110, edges_s, draw, draw)
    sound = faulty_nodes.spoken(spec, 0b1011001110, turn.row)
    (inverted,) = faulty_nodes.inverted(turn)
    assert np.array_equal(inverted[0], -sound)
    (half,) = faulty_nodes.half_twice(turn)
    assert np.array_equal(half[0], np.tile(sound[: sound.size // 2], 2))
    (other,) = faulty_nodes.other_row(turn)
    assert abs(float(other[0] @ sound)) < 1e-3
    assert len(list(faulty_nodes.doubled(2)(turn))) == 3
    assert not list(faulty_nodes.dead(turn))
