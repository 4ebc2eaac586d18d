# SPDX-License-Identifier: Apache-2.0

"""Stamps of recorded frames: by the whole recording, right from the first frame on."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from tactile_cdma.base.errors import TactileError
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.recording.offline import RawCapture, _FittedClock, _ObservedClock, fitted_clocks
from tactile_cdma.recording.recording_file import Description, RecordingEncoder, read_bytes
from tactile_cdma.wire.messages import Info, Quiet, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.simulated import stream
from torture.fuzz import corpus

CONFIG = SkinConfig.of({})
PERIOD_S, NEAR_S = CONFIG.spec.frame_period_s, 0.2e-3
WALL_S, MONOTONIC_S = 1.7e9, 5000.0
Packet = Info | Samples | Quiet
Read = tuple[Packet, float]
"""A packet, and the true host time at which it left the digitizer, s."""


@cache
def packets(frames: int, scene: str = "moving") -> tuple[Packet, ...]:
    data = stream(CONFIG, f"sim://?scene={scene}&seed=3", frames)
    return tuple(p for p in PacketParser().feed(data) if isinstance(p, Packet))


def session(
    frames: int = 400, begin_s: float = 0.0, drift: float = 0.0, device_s: float = 0.0
) -> list[Read]:
    """A stream that begins at a host time and a device time, s; drift: host time in excess, 1."""
    reads: list[Read] = []
    end_s = 0.0
    for packet in packets(frames):
        if not isinstance(packet, Info):
            count = packet.count if isinstance(packet, Quiet) else len(packet.counts)
            end_s = packet.device_time_us * 1e-6 + count * CONFIG.spec.chip_s / 4
            packet = replace(packet, device_time_us=packet.device_time_us + round(device_s * 1e6))
        reads.append((packet, begin_s + end_s * (1 + drift)))
    return reads


def write(
    path: Path, *sessions: list[Read], late_s: Callable[[int], float] = lambda _: 0.0
) -> Path:
    """The recording of these streams, each with packet numbers of its own. late_s: of each read."""
    about = Description(int(WALL_S * 1e9), int(MONOTONIC_S * 1e9), "sim://", 9600, {}, "0")
    encoder, number, newest_s = RecordingEncoder(about, 7), 0, 0.0
    data = encoder.begin()
    for reads in sessions:
        writer = PacketWriter()
        for packet, left_s in reads:
            newest_s = max(newest_s, left_s + late_s(number))  # bytes do not overtake each other
            number += 1
            data += encoder.chunk(writer.encode(packet), MONOTONIC_S + newest_s)
    path.write_bytes(data + encoder.end(MONOTONIC_S + newest_s))
    return path


def usb(seed: int, held_up_s: float = 0.105) -> Callable[[int], float]:
    """Delays of a bus, with a start that is held up and stalls now and then, s."""
    rng = np.random.default_rng(seed)

    def late_s(number: int) -> float:
        stall_s = 0.1 * rng.random() if rng.random() < 0.01 else 0.0
        return rng.exponential(0.5e-3) + stall_s + held_up_s * (number < 30)

    return late_s


def walls(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Device times and Unix times, s, of the frames of a recording."""
    pairs = [(frame.t_middle, wall_s) for frame, wall_s in RawCapture(path, {}).timed_frames()]
    device_s, wall_s = np.array(pairs).T
    return device_s, wall_s


def off_raster_s(stamps_s: NDArray[np.float64], period_s: float = PERIOD_S) -> float:
    """Largest difference of two consecutive stamps' distance from whole frame periods, s."""
    steps_s = np.diff(stamps_s)
    assert (steps_s > 0.5 * period_s).all()
    return float(np.abs(steps_s - period_s * np.round(steps_s / period_s)).max())


def with_holes(reads: list[Read]) -> list[Read]:
    """Without its second second, and some packets more."""
    return [r for i, r in enumerate(reads) if not (1.0 < r[1] < 2.0 or i % 97 == 96)]


@pytest.mark.parametrize("drift", [0.0, 100e-6, -100e-6])
@pytest.mark.parametrize("frames", [12, 90, 1200])
def test_stamps_are_a_period_apart_from_the_first_frame_on(
    tmp_path: Path, frames: int, drift: float
) -> None:
    path = write(tmp_path / "a.skin", session(frames, drift=drift), late_s=usb(frames))
    device_s, wall_s = walls(path)
    assert len(wall_s) >= frames - 2
    assert off_raster_s(wall_s) < NEAR_S
    # A bus is late by something: stamps are off by the least of it.
    assert np.abs(wall_s - WALL_S - device_s * (1 + drift)).max() < 2e-3 + 0.105 * (frames < 30)


def test_live_stamps_of_the_same_bytes_are_not(tmp_path: Path) -> None:
    """So the other tests have something to find."""
    path = write(tmp_path / "a.skin", session(), late_s=usb(1))
    live_s = np.array([frame.t_host for frame in RawCapture(path, {}).frames()])
    assert np.diff(live_s).min() < 0.5 * PERIOD_S


@pytest.mark.parametrize("renumbered", [False, True])
def test_a_digitizer_that_starts_over_is_stamped_on(tmp_path: Path, renumbered: bool) -> None:
    """Its count of samples begins anew; after a reset (renumbered), so does its clock."""
    first, drift = session(200, drift=8e-5), 8e-5
    pause_s = 200 * PERIOD_S + 0.7
    second = session(200, begin_s=pause_s * (1 + drift), drift=drift)
    if not renumbered:
        second = session(200, pause_s * (1 + drift), drift, device_s=pause_s)
    path = write(tmp_path / "a.skin", first, second, late_s=usb(3))
    device_s, wall_s = walls(path)
    assert len(wall_s) > (360 if renumbered else 390)  # packets with old numbers are repeats
    begins = int(np.argmax(np.diff(wall_s))) + 1
    for part in (wall_s[:begins], wall_s[begins:]):
        assert off_raster_s(part) < NEAR_S
    true_s = device_s + pause_s * (np.arange(len(device_s)) >= begins) * renumbered
    assert np.abs(wall_s - WALL_S - true_s * (1 + drift)).max() < 2e-3


@pytest.mark.parametrize("halts_s", [(5.0,), (0.5, 0.02)])
def test_a_clock_that_stood_still_is_stamped_right_before_and_after(
    tmp_path: Path, halts_s: tuple[float, ...]
) -> None:
    """With its device: nothing is missing, and only arrivals tell."""
    reads, begins = session(1200, drift=2e-5), []
    for halt, halt_s in enumerate(halts_s):
        begins.append(next(t for _, t in reads if t > 4.0 + 5.0 * halt))
        reads = [(packet, t + halt_s * (t > begins[-1])) for packet, t in reads]
    path = write(tmp_path / "a.skin", reads, late_s=usb(5))
    found = [(f.t_middle, w, f.stamp_uncertainty_s) for f, w in RawCapture(path, {}).timed_frames()]
    device_s, wall_s, claimed_s = np.array(found).T
    true_s = device_s * (1 + 2e-5)
    for begin_s, halt_s in zip(begins, halts_s, strict=True):
        true_s = true_s + halt_s * (true_s > begin_s)
    off_s = np.abs(wall_s - WALL_S - true_s)
    assert (off_s < claimed_s + 1e-3).all(), "a bus is late by something"
    assert (off_s < 2e-3).mean() > 0.95


@pytest.mark.parametrize("pace", [0.1, 2.0])
def test_a_stream_at_another_pace_is_stamped_as_it_came(tmp_path: Path, pace: float) -> None:
    """As a simulation at speed=10, or a replay at half of it."""
    path = write(tmp_path / "a.skin", session(drift=pace - 1))
    device_s, wall_s = walls(path)
    assert np.abs(wall_s - WALL_S - pace * device_s).max() < 0.02
    assert off_raster_s(wall_s, pace * PERIOD_S) < 0.1 * pace * PERIOD_S


def test_every_export_has_these_stamps(tmp_path: Path) -> None:
    path = write(tmp_path / "a.skin", with_holes(session(drift=5e-5)), late_s=usb(4))
    device_s, wall_s = walls(path)
    assert len(wall_s) < 330, "holes count as whole periods"
    assert np.abs(wall_s - WALL_S - device_s * (1 + 5e-5)).max() < 2e-3
    for output, *options in (["a.npz"], ["a.csv"], ["a", "--bag"]):
        assert main(["export", str(path), "-o", str(tmp_path / output), *options]) == 0
    assert np.array_equal(np.load(tmp_path / "a.npz")["wall_time_s"], wall_s)
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    assert np.array_equal(table["wall_time_s"], wall_s)
    with AnyReader([tmp_path / "a"]) as bag:
        ns = [t for c, t, _ in bag.messages() if c.topic == "/skin/tactile"]
    assert np.abs(np.array(ns) * 1e-9 - wall_s).max() < 1e-6
    assert off_raster_s(wall_s) < NEAR_S


@settings(max_examples=10)
@given(
    seed=st.integers(0, 999),
    drift=st.floats(-1e-4, 1e-4),
    begin=st.integers(0, 300),
    length=st.integers(20, 400),
    held_up_s=st.floats(0.0, 0.3),
)
def test_any_part_of_a_stream_is_stamped_evenly(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    drift: float,
    begin: int,
    length: int,
    held_up_s: float,
) -> None:
    whole = session(400, drift=drift)
    info = [read for read in whole if isinstance(read[0], Info)][:1]
    of_frame = len(whole) / 400
    part = info + whole[1 + round(begin * of_frame) : 1 + round((begin + length) * of_frame)]
    path = tmp_path_factory.mktemp("part") / "a.skin"
    device_s, wall_s = walls(write(path, part, late_s=usb(seed, held_up_s)))
    assert off_raster_s(wall_s) < NEAR_S
    error_s = wall_s - WALL_S - device_s * (1 + drift)
    assert np.ptp(error_s) < 1e-3


def test_a_crystal_that_warms_up_is_followed_for_hours() -> None:
    """By 2 ppm in ten minutes, there and back."""
    clock, rng = _ObservedClock(), np.random.default_rng(5)

    def host_s(device_s: NDArray[np.float64]) -> NDArray[np.float64]:
        warm_s = 600 / (2 * np.pi)
        return 300.0 + device_s * (1 + 40e-6) + 1e-6 * warm_s * np.sin(device_s / warm_s)

    device_s = np.arange(0, 6 * 3600, 0.25)
    arrivals_s = host_s(device_s) + rng.exponential(0.3e-3, device_s.size)
    for pair in zip(device_s.tolist(), arrivals_s.tolist(), strict=True):
        clock.observe(*pair)
    assert clock.arrivals == device_s.size
    fitted = _FittedClock(*clock.knots())
    error_s = np.array([fitted.to_host(t) for t in device_s.tolist()]) - host_s(device_s)
    assert -0.05e-3 < error_s.min() <= error_s.max() < 0.2e-3


def test_a_recording_that_grows_meanwhile_is_stamped_to_its_end(tmp_path: Path) -> None:
    first, second = session(100), session(100, begin_s=100 * PERIOD_S + 0.7)
    clocks = fitted_clocks(CONFIG, read_bytes(write(tmp_path / "a.skin", first)))
    pipeline = Pipeline(CONFIG, clocks=clocks)
    grown = write(tmp_path / "b.skin", first, second)
    stamps_s = [f.t_host for data, t in read_bytes(grown) for f in pipeline.feed(data, t)]
    assert len(stamps_s) > 160
    assert (np.diff(stamps_s) > 0).all()
    assert stamps_s[-1] == pytest.approx(MONOTONIC_S + second[-1][1], abs=2 * PERIOD_S)


def hostile() -> Iterator[Any]:
    """Kept recordings of the fuzzer, and its lines with hostile bytes as recordings."""
    for name, raw in corpus.read("recording").items():
        yield pytest.param(raw, id=name)
    about = Description(int(WALL_S * 1e9), int(MONOTONIC_S * 1e9), "sim://", 9600, {}, "0")
    for name, data in corpus.read("line").items():
        encoder = RecordingEncoder(about, 7)
        raw = encoder.begin()
        for i in range(0, len(data), 64):
            raw += encoder.chunk(data[i : i + 64], MONOTONIC_S + i * 1e-5)
        yield pytest.param(raw, id=f"line {name}")


@pytest.mark.parametrize("content", list(hostile()))
def test_stamps_of_hostile_recordings_rise(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.skin"
    path.write_bytes(content)
    try:
        stamps_s = [wall_s for _, wall_s in RawCapture(path, {}).timed_frames()]
    except TactileError:
        return
    assert (np.diff(stamps_s) > 0).all()
