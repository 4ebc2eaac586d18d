# SPDX-License-Identifier: Apache-2.0

"""What is said of nodes that may have spoken in frames that were not heard."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from benchmarks.doubt.printed import FastCondition
from benchmarks.doubt.tally import total
from benchmarks.doubt.touches import conditions
from benchmarks.doubt.words import play
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.readings.contact import ContactThresholds, ContactTracker
from tactile_cdma.readings.status import Status
from tactile_cdma.wire.messages import Quiet, Received, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.independent_line import Digitizer, Line, Skin, Talk, render
from test.support.simulated import stream

HEARTBEAT = 20
IDLE = f"sim://?seed=1&scene=idle&heartbeat={HEARTBEAT}"
Edit = Callable[[int, Samples | Quiet], Samples | Quiet | None]


def heard(
    edit: Edit, url: str = IDLE, frames: int = 80, **parameters: object
) -> list[TactileFrame]:
    """Frames of a stream whose packets of samples are edited, by the number of the frame."""
    config = SkinConfig.of(parameters)  # type: ignore[arg-type]
    pipeline, writer = Pipeline(config), PacketWriter()
    found, number = [], -1
    for packet in PacketParser().feed(stream(config, url, frames)):
        kept: Received | None = packet
        if isinstance(packet, (Samples, Quiet)):
            number += packet.sync
            kept = edit(number, packet)
        data = writer.encode(packet if kept is None else kept)
        found += [] if kept is None else pipeline.feed(data, packet_s(packet))
    return found + pipeline.flush()


def packet_s(packet: object) -> float:
    return getattr(packet, "device_time_us", 0) * 1e-6


def is_unheard(status: np.ndarray) -> np.ndarray:
    """Both bits of UNHEARD are set."""
    return np.asarray(status & Status.UNHEARD == Status.UNHEARD)


def unheard(frame: TactileFrame) -> int:
    return int(np.count_nonzero(is_unheard(frame.readings.status)))


@pytest.mark.parametrize("lost", [40, 47])
def test_after_a_lost_frame_every_node_is_unheard_until_its_heartbeat(lost: int) -> None:
    frames = heard(lambda n, packet: None if n == lost else packet)
    tracker = ContactTracker(SkinConfig.of({}).layout, ContactThresholds(1000, 500))
    untouched = {f.sequence: tracker.update(f.readings, f.t_middle).untouched for f in frames}
    [gap] = [b.sequence for a, b in pairwise(frames) if b.sequence > a.sequence + 1]
    spoken = np.zeros(16, bool)
    for frame in frames:
        status = frame.readings.status
        if HEARTBEAT <= frame.sequence < gap:
            assert untouched[frame.sequence]
        if frame.sequence >= gap:
            spoken |= frame.words.active
            assert np.array_equal(is_unheard(status), ~spoken)
            assert np.isfinite(frame.readings.pressure_pa).all()
            assert untouched[frame.sequence] == spoken.all()
    assert spoken.all()


def test_where_nodes_repeat_only_those_are_unheard_that_spoke_before_the_loss() -> None:
    """A press ends in the lost frames: its nodes speak in every frame until then."""
    url = "sim://?seed=1&scene=moving&heartbeat=20"
    frames = heard(lambda n, packet: None if 40 <= n < 60 else packet, url, nodes_repeat=True)
    [(last, first)] = [(a, b) for a, b in pairwise(frames) if b.sequence > a.sequence + 1]
    silent = ~first.words.active
    assert (last.words.active & silent).any()
    assert np.array_equal(is_unheard(first.readings.status), last.words.active & silent)


def test_by_change_a_touch_is_held_and_what_was_said_unheard_is_unknown() -> None:
    """The press gets to its load, and rests there, in frames that are lost."""
    url = "sim://?seed=1&scene=press&heartbeat=60&speaks=change"
    whole = {frame.sequence: frame for frame in heard(lambda n, packet: packet, url, 200)}
    frames = heard(lambda n, packet: None if 80 <= n < 100 else packet, url, 200)
    held = hidden = 0
    spoken = np.zeros(16, bool)
    for frame in frames[60:]:
        true_pa, status = whole[frame.sequence].readings.pressure_pa, frame.readings.status
        off = np.abs(frame.readings.pressure_pa - true_pa) > 250
        certain = status & (Status.LOW_SNR | Status.STALE) == 0
        if frame.sequence >= 100:
            spoken |= frame.words.active
            assert np.array_equal(certain, spoken)
        assert not (certain & off).any()
        hidden += np.count_nonzero(off)
        held += np.count_nonzero(certain & ~frame.words.active & (true_pa > 5e3))
    assert hidden > 20, "nothing was there"
    assert held > 50 and spoken.all()


def test_where_every_node_speaks_in_every_frame_none_is_unheard() -> None:
    url = "sim://?seed=1&scene=moving&threshold=0"
    frames = heard(lambda n, packet: None if n % 5 == 4 else packet, url, 40)
    assert len(frames) > 25
    assert not any(map(unheard, frames))


def test_after_a_restart_of_the_stream_every_node_is_unheard() -> None:
    """Also where time goes on and no frame seems to be missing."""

    def begins_anew(number: int, packet: Samples | Quiet) -> Samples | Quiet:
        return packet if number < 40 else replace(packet, first_index=packet.first_index - 20_000)

    frames = heard(begins_anew)
    assert [unheard(f) for f in frames[25:38]] == [0] * 13
    assert max(map(unheard, frames[38:45])) >= 14
    assert unheard(frames[-1]) == 0


def test_a_clock_that_begins_anew_leaves_nothing_held() -> None:
    def reset(number: int, packet: Samples | Quiet) -> Samples | Quiet:
        moved_us = 10_000_000 if number < 40 else 0
        return replace(packet, device_time_us=packet.device_time_us + moved_us)

    frames = heard(reset)
    assert np.count_nonzero(np.isnan(frames[42].readings.pressure_pa)) >= 12


@pytest.mark.parametrize(
    "condition",
    [some for some in conditions() if "20%" in some.name or "spikes" in some.name],
    ids=lambda some: some.name,
)
def test_no_claim_outlives_what_was_heard(condition: object) -> None:
    """Promise 1 of docs/reliability.md, of packets that are lost or not as they were sent.

    Hum of 2 A leaves no frame certain, and nothing is claimed.
    """
    tally, complaints = condition.run(40, 7)  # type: ignore[attr-defined]
    assert tally.claims > 100 or "hum of 2 A" in condition.name  # type: ignore[attr-defined]
    assert tally.unclaimed > 5, "it was blind"
    assert tally.stale_claims == 0, complaints[:3]


@pytest.mark.parametrize("hit", [False, True], ids=["packets", "impulses"])
@pytest.mark.parametrize("period", [1.0, 1.5, 1.7, 2.0, 3.0])
@pytest.mark.parametrize(
    "digitizer", [Digitizer(), Digitizer(samples_per_chip=8, integrated=True)], ids=["raw", "mean"]
)
def test_of_frames_that_come_faster_than_told_no_loss_goes_unnoticed(
    digitizer: Digitizer, period: float, hit: bool
) -> None:
    condition = FastCondition("", digitizer, period, hit)
    found = total(condition.run(150, seed)[0] for seed in range(3))
    assert found.fast_frames == 0
    assert found.claims > 100, "it was blind"


@pytest.mark.parametrize("hit", [False, True], ids=["packets", "impulses"])
@pytest.mark.parametrize("period", [1.0, 1.2, 1.5, 2.0, 3.0])
def test_lost_frames_are_counted_by_how_they_come(period: float, hit: bool) -> None:
    """And not by how often they would come as told, once that has been seen."""
    skin = Skin()
    line = Line(impulses_hz=100.0, impulse_v=50.0, impulse_chips=20.0) if hit else Line()
    recording = render(skin, Talk(share=0.15), line, Digitizer(), 150, 0)
    told_ms = 1e3 * skin.chip_s * skin.period_chips * period
    starts = np.array([frame.start_chips for frame in recording.frames])
    played = play(recording, lost=0.05 * (not hit), frame_period_ms=told_ms)
    found = [(np.argmin(np.abs(starts - f.t_start / skin.chip_s)), f.sequence) for f, _ in played]
    numbers, sequence = np.array(found[8:]).T
    assert np.array_equal(np.diff(numbers), np.diff(sequence))
    assert (np.diff(numbers) > 1).sum() > 4, "none was lost"


def test_silence_that_is_lost_between_frames_leaves_nobody_unheard() -> None:
    """On a line whose frames come as told, where no frame can have been there."""
    frames = heard(lambda n, packet: packet if n % 7 or packet.sync else None)
    assert not any(unheard(frame) for frame in frames[HEARTBEAT:])
