# SPDX-License-Identifier: Apache-2.0

"""A short run of the accelerated day, and the defects that it must find."""

import gc
import mmap
import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.clock import DeviceClock
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.rest import rest_file
from tactile_cdma.sim.options import SimOptions
from test.support.damaged_frames import another_pressure, another_word, nobody, with_readings
from torture.day import campaign as day
from torture.day import host_clock, saves
from torture.day.host_clock import HostClock, UsbLine
from torture.day.judge import DayJudge, Lap
from torture.day.laps import LapWriter, Stretch, record
from torture.outcome import Plan
from torture.process_watch import SECTIONS, Watch, slope

pytestmark = pytest.mark.xdist_group("day")  # its stretch is made once
CONFIG = SkinConfig.of(day.SKIN)
SEED = 3
Decoded = tuple[list[Lap], list[TactileFrame]]


@pytest.fixture(autouse=True)
def few_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counting all objects of pytest takes long."""
    monkeypatch.setattr(day, "LOOKS", 40)
    monkeypatch.setattr(day, "COUNTS", 2)


@pytest.fixture(scope="module")
def stretch() -> Stretch:
    return record(CONFIG, SimOptions(scene="presses", heartbeat=40), 40)


@pytest.fixture(scope="module")
def decoded(stretch: Stretch) -> Decoded:
    """100 frames of a sound day, and what was told."""
    pipeline, laps, frames = Pipeline(CONFIG), list[Lap](), list[TactileFrame]()
    for t_s, data in day.Telling([stretch, stretch], SEED).bursts(100, laps.append):
        frames += pipeline.feed(data, t_s)
    return laps, frames


def judged(decoded: Decoded, damage: Callable[[list[TactileFrame]], object]) -> DayJudge:
    """What is said of frames that were damaged after they had been decoded."""
    laps, sound = decoded
    judge, frames = DayJudge(CONFIG, lambda t_s: t_s), list(sound)
    for lap in laps:
        judge.told(lap)
    damage(frames)
    for frame in frames:
        judge.judge(frame)
    return judge


def test_a_slice_of_a_day_is_good(stretch: Stretch, monkeypatch: pytest.MonkeyPatch) -> None:
    """20 s before all counters run over, and 10 s after; with stalls."""
    monkeypatch.setattr(host_clock, "STALL_EVERY_S", (8.0, 9.0))
    telling = day.Telling([stretch, stretch], SEED)
    wrapping, usb = day.day(CONFIG, telling, 30.0, SEED)
    assert wrapping.good, wrapping
    assert usb.good, usb
    assert wrapping.times == 3
    assert usb.times >= 1


def test_a_replayed_part_is_good(stretch: Stretch) -> None:
    outcome = day.replayed(CONFIG, day.Telling([stretch, stretch], SEED), 10.0)
    assert outcome.good, outcome
    assert outcome.said == "98 frames"


@pytest.mark.parametrize(
    "damage",
    [
        another_word,
        nobody,
        another_pressure,
        lambda frame: with_readings(frame, status=frame.readings.status ^ 4),
        lambda frame: replace(frame, t_start=frame.t_start + 5e-6),
    ],
)
def test_a_false_frame_is_found(
    damage: Callable[[TactileFrame], TactileFrame], decoded: Decoded
) -> None:
    def put(frames: list[TactileFrame]) -> None:
        frames[60] = damage(frames[60])

    assert judged(decoded, put).wrong == 1


def test_a_lost_frame_is_found(decoded: Decoded) -> None:
    assert judged(decoded, lambda frames: frames.pop(60)).uncounted == 39


def test_a_false_stamp_is_found(decoded: Decoded) -> None:
    def late(frames: list[TactileFrame]) -> None:
        frames[:] = [replace(frame, t_host=frame.t_middle + 0.5e-3) for frame in frames]
        frames[-1] = replace(frames[-1], t_host=frames[-1].t_middle - 1.1e-3)

    judge = judged(decoded, late)
    assert judge.stamps_beyond(day.MOST_ERROR_S) == 1
    assert judge.stamp_error_s(0.5) == pytest.approx(0.5e-3, abs=2e-6)
    assert judge.worst_s == pytest.approx(1.1e-3, abs=2e-6)


def plant(monkeypatch: pytest.MonkeyPatch, damage: Callable[[bytes, int], bytes]) -> None:
    """Damages what is told, packet by packet, after it was counted."""
    tell, told = LapWriter.tell, [0]

    def other(self: LapWriter, *arguments: Any) -> bytes:
        told[0] += 1
        return damage(tell(self, *arguments), told[0])

    monkeypatch.setattr(LapWriter, "tell", other)


def test_a_lost_packet_is_found(stretch: Stretch, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, lambda data, number: b"" if number == 200 else data)
    outcome, _ = day.day(CONFIG, day.Telling([stretch, stretch], SEED), 5.0, SEED)
    assert outcome.uncounted_losses


def test_a_driver_that_stops_is_found(stretch: Stretch, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, lambda data, number: data if number < 200 else b"")
    monkeypatch.setattr(day, "PATIENCE_S", 0.5)
    outcome = day.replayed(CONFIG, day.Telling([stretch, stretch], SEED), 10.0)
    assert outcome.hangs == 1


def test_a_clock_that_falls_for_a_stall_is_found(
    stretch: Stretch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it was before: the newest arrivals alone, whatever held them back."""
    monkeypatch.setattr(DeviceClock, "to_host", lambda self, t_s: self._host.max())
    _, usb = day.day(CONFIG, day.Telling([stretch, stretch], SEED), 10.0, SEED)
    assert usb.wrong_values


def memory(leaks: ExitStack) -> None:
    """Pages of their own: malloc may give a hole of earlier tests, and nothing grows."""
    pages = mmap.mmap(-1, 1 << 24, flags=mmap.MAP_PRIVATE)
    pages.write(bytes(1 << 24))
    leaks.callback(pages.close)


def thread(leaks: ExitStack) -> None:
    end = threading.Event()
    waiting = threading.Thread(target=end.wait)
    waiting.start()
    leaks.callback(waiting.join)
    leaks.callback(end.set)


@pytest.mark.parametrize(
    ("leak", "grown"),
    [
        (lambda leaks: None, False),
        (memory, True),
        (lambda leaks: leaks.callback(len, [[] for _ in range(500)]), True),
        (lambda leaks: leaks.callback(os.close, os.open(os.devnull, os.O_RDONLY)), True),
        (thread, True),
    ],
    ids=["nothing", "memory", "objects", "a file", "a thread"],
)
def test_what_a_process_holds_more_of_is_found(
    leak: Callable[[ExitStack], object], grown: bool
) -> None:
    gc.collect()  # what other tests have left must not go meanwhile
    holdings = day.Holdings()
    with ExitStack() as leaks:
        for step in range(day.LOOKS + 1):
            if step == day.LOOKS // 2:
                leak(leaks)
            holdings.look(step / day.LOOKS, 30.0 * step)
    assert bool(holdings.grown) == grown


def test_a_leak_has_a_slope_through_noise_and_visits() -> None:
    rng, t_s = np.random.default_rng(0), np.arange(1200) * 3.0
    noise_kb = rng.integers(0, 50, t_s.size) * 4.0
    guests_kb = 3000.0 * (t_s % 120 < 40)
    flat, leaking = noise_kb + guests_kb, noise_kb + guests_kb + 2000 * t_s / 3600
    assert abs(slope(t_s, flat).kb_per_h) < 100
    assert slope(t_s, leaking).kb_per_h == pytest.approx(2000, abs=200)
    assert slope(t_s, leaking).spread_kb_per_h < 300
    assert np.isnan(slope(t_s[:SECTIONS], flat[:SECTIONS]).kb_per_h)


def test_a_process_that_ended_is_not_looked_at() -> None:
    watch = Watch(2**22 + 1)  # beyond Linux's largest
    watch.look()
    assert not watch.t_s and not watch.more_is_held


def test_usb_is_never_early_and_keeps_the_order() -> None:
    line, last_s = UsbLine(np.random.default_rng(4)), 0.0
    delays_s = []
    for step in range(20_000):
        sent_s = 5.0 + 0.0512 * step
        read_s = line.read_at(sent_s)
        assert read_s >= max(last_s, sent_s)
        delays_s.append(read_s - sent_s)
        last_s = read_s
    assert np.median(delays_s) < 1.2e-3
    assert line.stalls >= 2 and max(delays_s) > 0.5
    assert line.late == pytest.approx(20, abs=15)


def test_the_hosts_clock_is_the_integral_of_its_rate() -> None:
    host = HostClock(np.random.default_rng(5))
    rates = [host.at(t_s + 1) - host.at(t_s) - 1 for t_s in (0.0, 1800.0, 20_000.0, 80_000.0)]
    assert all(abs(rate - host.crystal) < 20e-6 for rate in rates)
    assert rates[1] - rates[0] > 3e-6  # it has warmed up


def test_no_tare_is_lost_to_a_kill(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(saves, "QUICK_KILLS", 5)
    assert saves.run(Plan(quick=True, seed=SEED)).good


def test_one_generation_of_old_files_and_litter_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it was: the file before the last one is gone, and killed writers' files stay."""

    def one_generation(path: Path) -> Path:
        os.replace(path, aside := path.with_name(f"{path.name}.old"))
        return aside

    path, found = tmp_path / "skin.rest.yaml", saves.Found()
    for number in range(3):
        saves._save(path, number)
    saves.judge(path, 3, found)
    assert found == saves.Found()
    (tmp_path / ".skin.rest.yaml.left").write_text("")
    for old in tmp_path.glob("*.old*"):
        old.unlink()
    monkeypatch.setattr(rest_file, "keep_aside", one_generation)
    for number in range(3):
        saves._save(path, number)
    saves.judge(path, 3, found)
    assert (found.lost, found.litter) == (1, 1)
