# SPDX-License-Identifier: Apache-2.0

"""Recordings replayed as ports give the same frames at every speed."""

import re
import threading
import time
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest

from tactile_cdma.base.errors import PortError, RecordingEndError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.driver import WAITING, Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.recording.offline import raw_frames
from tactile_cdma.recording.recording_file import Recorder, describe, read_bytes, survey
from tactile_cdma.replay.player import Player, ReplayOptions
from tactile_cdma.wire.port import Port
from test.support.command_line import Printed, Refused
from test.support.same_frames import assert_same
from test.support.waiting import PATIENCE_S

pytestmark = pytest.mark.xdist_group("replay")  # its recording is made once
CONFIG = SkinConfig.of({})
URL = "sim://?scene=moving&seed=4&speed=2"
SECONDS = 1.2
Live: TypeAlias = tuple[Path, list[TactileFrame]]
"""A recording, and what the decoder made of its bytes while they came."""


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Live:
    path = tmp_path_factory.mktemp("replay") / "moving skin.skin"
    frames, pipeline, session = list[TactileFrame](), Pipeline(CONFIG), Session(CONFIG)
    with Port(URL, 9600) as port, Recorder(path, URL, 9600, {}) as recorder:
        port.write(session.open())
        end = time.monotonic() + SECONDS
        while time.monotonic() < end or len(frames) <= 100:  # a busy machine makes fewer
            data, t_host = port.read()
            recorder.write(data, t_host)
            frames += pipeline.feed(data, t_host)
    return path, frames


def url_of(path: Path, query: str = "") -> str:
    return f"replay://{path}".replace(" ", "%20") + (f"?{query}" if query else "")


def replayed(url: str, enough: int | None = None) -> tuple[list[TactileFrame], list[str], float]:
    """All frames of a replay (or so many), what the driver complained of, and how long it took."""
    frames, problems, done = list[TactileFrame](), list[str](), threading.Event()

    def keep(frame: TactileFrame) -> None:
        frames.append(frame)
        if len(frames) == enough:
            done.set()

    def note(problem: str | None) -> None:
        if problem not in (None, WAITING):
            problems.append(str(problem))
            if "has ended" in str(problem):  # a busy machine may seem a silent digitizer before
                done.set()

    begin = time.monotonic()
    driver = Driver(CONFIG, url, 9600, keep, note)
    driver.start()
    assert done.wait(PATIENCE_S)
    took_s = time.monotonic() - begin
    driver.stop()
    assert driver.connections == 1
    return frames, problems, took_s


def assert_same_words(some: list[TactileFrame], whole: list[TactileFrame]) -> None:
    """Each of some says what that of the whole says at its time, to within the clock's rounding."""
    times_s = np.array([frame.t_start for frame in whole])
    for frame in some:
        at = int(np.abs(times_s - frame.t_start).argmin())
        assert times_s[at] == pytest.approx(frame.t_start, abs=1e-4)
        original = whole[at].words
        assert np.array_equal(frame.words.active, original.active)
        assert np.array_equal(frame.words.codes[original.active], original.codes[original.active])


@pytest.mark.parametrize("speed", [0, 1])
def test_a_replay_is_decoded_bit_for_bit_as_it_was_live(live: Live, speed: float) -> None:
    path, frames = live
    again, problems, took_s = replayed(url_of(path, f"speed={speed}"))
    assert_same(again, frames, at_host=False)
    assert problems[-1].endswith("the recording has ended")
    if speed == 1:
        times = [t_host for _, t_host in read_bytes(path)]
        assert took_s > times[-1] - times[0] - 1e-3
        passed_s = again[-1].t_host - again[0].t_host
        assert passed_s == pytest.approx(frames[-1].t_host - frames[0].t_host, abs=0.3)


def test_decoding_the_file_gives_the_same(live: Live) -> None:
    path, frames = live
    offline = list(raw_frames(path, Pipeline(CONFIG)))
    assert_same(offline[: len(frames)], frames, at_host=False)
    assert len(offline) - len(frames) in (0, 1)  # at the end of a file a last frame is given up
    for one, other in zip(offline, frames, strict=False):
        assert one.t_host == pytest.approx(other.t_host, abs=1e-6)


def test_a_loop_goes_on_with_rising_sequence_numbers(live: Live) -> None:
    path, frames = live
    wanted = 2 * len(frames) + 10
    again, problems, _ = replayed(url_of(path, "speed=0&loop=true"), wanted)
    assert not any("has ended" in problem for problem in problems)
    sequence = [frame.sequence for frame in again[:wanted]]
    assert all(np.diff(sequence) >= 1)
    assert_same(again[: len(frames)], frames, at_host=False)


def test_a_loop_over_a_file_that_was_taken_away_says_so(live: Live, tmp_path: Path) -> None:
    path = tmp_path / "going.skin"
    for emptied, message in ((False, "No such file"), (True, "no longer holds bytes")):
        path.write_bytes(live[0].read_bytes())
        with Port(url_of(path, "speed=0&loop=true"), 9600) as port:
            path.unlink()
            if emptied:
                path.touch()
            with pytest.raises(PortError, match=message):
                while True:
                    port.read()


def test_a_part_is_replayed_with_what_describes_it(live: Live) -> None:
    path, frames = live
    part, _, _ = replayed(url_of(path, "speed=0&start=0.4&end=0.8"))
    began_s, pieces = describe(path).monotonic_ns * 1e-9, list(read_bytes(path))
    inside = sum(len(data) for data, t_host in pieces if 0.4 <= t_host - began_s <= 0.8)
    share = inside / sum(len(data) for data, _ in pieces)
    assert 0 < share < 1
    assert len(part) == pytest.approx(share * len(frames), abs=4)
    assert_same_words(part, frames)


def test_bytes_come_when_they_are_due(live: Live) -> None:
    path, _ = live
    now_s = 100.0
    player = Player(ReplayOptions.from_url(url_of(path, "speed=2")), lambda: now_s)
    came: list[tuple[float, bytes]] = []
    while not player.ended:
        wait_s = player.advance(1 << 20)
        came.append((now_s, player.take(1 << 20)))
        now_s += min(wait_s, 10.0)
    original = list(read_bytes(path))
    assert b"".join(data for _, data in came) == b"".join(data for data, _ in original)
    length_s = original[-1][1] - original[0][1]
    assert came[-1][0] - 100.0 == pytest.approx(length_s / 2, abs=1e-6)


def test_a_damaged_and_cut_recording_plays_what_it_has_and_says_what_is_missing(
    live: Live, tmp_path: Path
) -> None:
    path, frames = live
    hurt = tmp_path / "hurt.skin"
    with Recorder(hurt, URL, 9600, {}) as recorder:  # in small pieces, however loaded we were
        for data, t_host in read_bytes(path):
            for begin in range(0, len(data), 1000):
                recorder.write(data[begin : begin + 1000], t_host)
    raw = bytearray(hurt.read_bytes())[:-10_000]
    raw[len(raw) // 3] ^= 255
    hurt.write_bytes(raw)
    again, problems, _ = replayed(url_of(hurt, "speed=0"))
    assert len(frames) / 2 < len(again) < len(frames)
    assert_same_words(again, frames)
    said = problems[-1]
    assert "has ended" in said and "cut short" in said and "damaged in" in said
    assert survey(hurt).lost_bytes > 0


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("replay://", "name the recording"),
        ("replay://nowhere/none.skin", "No such file"),
        ("replay://PATH?pace=2", "no option 'pace'.*speed"),
        ("replay://PATH?speed=-1", "0…1000"),
        ("replay://PATH?speed=fast", "speed"),
        ("replay://PATH?speed=0.01", "0.1"),
        ("replay://PATH?loop=maybe", "true or false"),
        ("replay://PATH?start=3&end=2", "not before end"),
        ("replay://PATH?start=50", "no bytes between"),
        ("replay://OTHER", "is not a recording"),
    ],
)
def test_what_cannot_be_replayed_is_one_clear_error(
    live: Live, tmp_path: Path, url: str, message: str
) -> None:
    other = tmp_path / "other.raw"
    other.write_bytes(b"\x01\x02\0" * 100)
    with pytest.raises(PortError, match=message) as caught:
        Port(url.replace("PATH", url_of(live[0])[9:]).replace("OTHER", str(other)), 9600)
    assert not isinstance(caught.value, RecordingEndError)
    assert "\n" not in str(caught.value)


def test_a_replay_can_be_recorded_and_inspected(
    live: Live, tmp_path: Path, printed: Printed
) -> None:
    path, frames = live
    copy = tmp_path / "copy.skin"
    printed("record", url_of(path, "speed=0"), copy)
    again, original = (b"".join(d for d, _ in read_bytes(file)) for file in (copy, path))
    assert again == original != b""
    said = printed("info", copy).out
    assert "16 nodes" in said and "checksum: right" in said
    counted = re.search(r"frames: (\d+), lost", said)
    assert counted and int(counted[1]) - len(frames) in (0, 1)
    copy.write_bytes(copy.read_bytes()[:-1000])
    assert "cut short" in printed("info", copy, code=1).out


def test_a_replay_is_never_recorded_over_what_it_replays(
    live: Live, tmp_path: Path, refused: Refused
) -> None:
    path = live[0]
    before, link = path.read_bytes(), tmp_path / "other name.skin"
    link.symlink_to(path)
    for target in (path, link):
        assert "is what replay://" in refused("record", url_of(path, "loop=1"), target, "--force")
    assert path.read_bytes() == before
