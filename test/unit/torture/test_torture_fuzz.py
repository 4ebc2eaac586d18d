# SPDX-License-Identifier: Apache-2.0

"""A short run of the campaign with hostile bytes, and the defects that it must find."""

import importlib.util
import os
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.wire import packets
from tactile_cdma.wire.packets import PacketParser
from torture.fuzz import bombs, campaign, corpus, garbage, streams
from torture.fuzz.harnesses import FIRMWARE
from torture.fuzz.search import search
from torture.fuzz.target import CRASH, SLOW, UNCOUNTED, WRONG, Target, inputs, trying
from torture.fuzz.targets import TARGETS
from torture.outcome import Plan

QUICK = Plan(quick=True, seed=2)


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_and_found_inputs_are_read_or_refused(name: str) -> None:
    target = TARGETS[name]
    with trying(target) as attempt:
        for data in [*target.seeds().values(), *corpus.read(name).values()]:
            assert attempt(data) is None


def test_every_corpus_belongs_to_a_target() -> None:
    names = {path.stem for path in corpus.FOLDER.iterdir()}
    assert {"line", "firmware_framing"} <= names
    harnesses = FIRMWARE.glob("fuzz/fuzz_*.c")
    assert names <= {*TARGETS, *(f"firmware_{path.stem[5:]}" for path in harnesses)}


def test_inputs_are_kept_and_unpacked_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(corpus, "FOLDER", tmp_path)
    inputs = {"empty": b"", "every_byte": bytes(range(256)), "text": b"a\n"}
    files = [tmp_path / name for name in inputs]
    for path, data in zip(files, inputs.values(), strict=True):
        path.write_bytes(data)
    assert corpus.read("new") == {}
    corpus.add("new", files[2:])
    corpus.add("new", files[:2])
    assert corpus.read("new") == inputs
    corpus.unpack("new", tmp_path / "unpacked")
    unpacked = {path.name: path.read_bytes() for path in (tmp_path / "unpacked").iterdir()}
    assert unpacked == inputs


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_anything_near_a_seed_is_read_or_refused(name: str, data: st.DataObject) -> None:
    target = TARGETS[name]
    known = data.draw(st.sampled_from(list(target.seeds().values())))
    begin = data.draw(st.integers(0, len(known)))
    end = data.draw(st.integers(begin, len(known)))
    other = data.draw(st.binary(max_size=40))
    with trying(target) as attempt:
        assert attempt(known[:begin] + other + known[end:]) is None


def test_a_slice_of_the_campaign_finds_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(campaign.GARBAGE_S, True, 0.03)
    assert campaign.waiting(tmp_path).good
    assert campaign.oversized(tmp_path, 1 << 16).good
    assert campaign.fed(QUICK).good


@pytest.mark.parametrize("bomb", sorted(bombs.YAML_BOMBS.keys() - campaign.LONG))
def test_bombs_are_refused(tmp_path: Path, bomb: str) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_bytes(bombs.YAML_BOMBS[bomb]())
    for read in bombs.YAML.values():
        bombs.refuse(read, path, measured=False)


@pytest.mark.slow
def test_a_search_by_coverage_finds_nothing(tmp_path: Path) -> None:
    if importlib.util.find_spec("atheris") is None:
        pytest.skip("atheris is not installed; make fuzz installs it")
    found = search("names", tmp_path, runs=2000, seconds=5, seed=1)
    assert found.inputs > 0 and found.coverage > 0
    assert not found.finds


# ---- what must be found ------------------------------------------------------------------------


@pytest.mark.slow
def test_a_search_keeps_what_it_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = search("no such target", tmp_path, runs=1, seconds=1, seed=1)
    assert [kind for kind, _ in found.finds] == [CRASH]


def kinds_of(target: Target, count: int = 60) -> set[str]:
    """The kinds of finds among seeds and mutations."""
    with trying(target) as attempt:
        stream = inputs(target, 1)
        finds = [attempt(next(stream)) for _ in range(count)]
    return {find.kind for find in finds if find is not None}


def planted(run: object, **others: object) -> Target:
    return Target("planted", run, lambda: {"a": b"abc"}, **others)  # type: ignore[arg-type]


def test_a_slice_of_fuzzing_ends_while_the_target_waits_for_a_disk() -> None:
    target = planted(lambda data: time.sleep(0.1))
    assert campaign.tried("planted", [target], QUICK).times < 5


def test_crashes_slowness_and_bad_messages_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(data: bytes) -> None:
        while True:
            pass

    def complain(data: bytes) -> None:
        raise CaptureError("")

    assert kinds_of(planted(lambda data: data[1 << 30])) == {CRASH}
    assert kinds_of(planted(complain, refuses=(CaptureError,))) == {CRASH}
    monkeypatch.setattr("torture.fuzz.target.HANG_S", 0.05)
    assert kinds_of(planted(hang), 1) == {SLOW}
    monkeypatch.setattr("torture.fuzz.target.SLOW_S", 0.0)
    assert kinds_of(planted(len), 1) == {SLOW}


def test_wrong_frames_and_miscounted_losses_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = Pipeline.feed

    def wrong(self: Pipeline, data: bytes, t_host: float) -> list[TactileFrame]:
        frames = feed(self, data, t_host)
        for frame in frames:
            frame.words.codes[0] ^= 1
        return frames

    streams.read_line(b"")  # the truth is known
    monkeypatch.setattr(Pipeline, "feed", wrong)
    assert kinds_of(TARGETS["line"], 1) == {WRONG}
    monkeypatch.setattr(Pipeline, "feed", feed)
    told = [name for name in packets._SCANNED if name != "lost_packets"]
    monkeypatch.setattr(packets, "_SCANNED", told)
    assert kinds_of(TARGETS["line"], 20) == {UNCOUNTED}


def test_a_stream_that_depends_on_the_split_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = Pipeline.feed

    def forgetful(self: Pipeline, data: bytes, t_host: float) -> list[TactileFrame]:
        return feed(self, data[:1000], t_host)

    streams.read_both_ways(b"")  # the true stream is known
    monkeypatch.setattr(Pipeline, "feed", forgetful)
    with trying(TARGETS["both ways"]) as attempt:
        found = attempt(b"")
    assert found is not None and found.kind == WRONG


def test_a_parser_that_depends_on_the_split_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = PacketParser.feed

    def forgetful(self: PacketParser, data: bytes) -> list:
        return feed(self, data[:-1] if len(data) < 4 else data)

    monkeypatch.setattr(PacketParser, "feed", forgetful)
    assert kinds_of(TARGETS["packets"]) == {WRONG}


def test_memory_that_grows_is_found() -> None:
    class Hoarder(Pipeline):
        def feed(self, data: bytes, t_host: float, backlog: bool = False) -> list[TactileFrame]:
            self.hoard = [*getattr(self, "hoard", []), bytearray(data)]
            return []

    hoarder = Hoarder(garbage.CONFIGS["line"])
    held = garbage.feed("noise", 1, garbage.MOST_HELD + (1 << 20), 60.0, hoarder)
    assert held.most > garbage.MOST_HELD


def test_readers_that_hang_or_take_what_they_should_not_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bombs, "HANG_S", 0.2)
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with pytest.raises(TimeoutError):
        bombs.refuse(Path.read_bytes, fifo)
    outcome = campaign._refused("planted", [(Path.read_bytes, fifo, True), (Path, fifo, True)])
    assert (outcome.crashes, outcome.hangs) == (1, 1)


def test_inputs_follow_from_the_seed_alone() -> None:
    def first(seed: int) -> list[bytes]:
        stream = inputs(TARGETS["layout"], seed)
        return [next(stream) for _ in range(30)]

    assert first(1) == first(1) != first(2)
