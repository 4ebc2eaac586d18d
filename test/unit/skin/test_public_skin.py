# SPDX-License-Identifier: Apache-2.0

"""The public interface: frames, contacts, tares, errors, examples; patches of a body as a skin."""

import asyncio
import doctest
import gc
import math
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import dropwhile, islice, pairwise
from pathlib import Path

import numpy as np
import pytest

import tactile_cdma
from tactile_cdma import (
    Body,
    BodyError,
    BodyFrame,
    Contact,
    Decoder,
    Frame,
    Origin,
    ParameterError,
    PortError,
    Refusal,
    RestError,
    Skin,
    Status,
    read_recording,
)
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.recording.recording_file import Recorder
from tactile_cdma.sim import Sphere
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.skin import LATEST_S
from test.support import simulated
from test.support.boards import chattering
from test.support.programs import run_python
from test.support.simulated import stream
from test.support.waiting import PATIENCE_S, wait_for

pytestmark = pytest.mark.xdist_group("public_skin")
ROOT = Path(__file__).resolve().parents[3]
IDLE = "sim://?scene=idle&heartbeat=2"  # every node speaks early, so that no taxel is awaited


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("public_skin") / "touch.skin"
    return simulated.recording(path, SimOptions(scene="moving", seed=3), 2.0)


def test_public_names_are_there_nothing_else_is_loaded_and_examples_run() -> None:
    probe = (
        "import sys, tactile_cdma as t\n"
        "assert 'numpy' not in sys.modules\n"
        "print([getattr(t, name).__doc__ is not None for name in t.__all__])\n"
        "print('rclpy' in sys.modules, set(t.__all__) <= set(dir(t)))\n"
    )
    answer = run_python("-c", probe, cwd=ROOT, check=True)
    assert "False" not in answer.stdout.splitlines()[0]
    assert answer.stdout.splitlines()[1] == "False True"
    with pytest.raises(AttributeError, match="no attribute 'Skim'"):
        _ = tactile_cdma.Skim  # type: ignore[attr-defined]
    result = doctest.testmod(sys.modules[Skin.__module__])
    assert (result.failed, result.attempted > 3) == (0, True)


def test_live_frames_come_in_order_with_all_that_a_program_wants() -> None:
    with Skin("sim://?scene=all", nodes=16) as skin:
        frames = list(islice(skin, 20))
        assert skin.problem is None
    assert all(after.sequence > before.sequence for before, after in pairwise(frames))
    assert all(after.t_host > before.t_host for before, after in pairwise(frames))
    last = frames[-1]
    assert abs(time.monotonic() - last.t_host) < 5.0
    assert last.positions_m.shape == (16, 3)
    assert last.nodes.tolist() == list(range(1, 17))
    assert last.active.any() and last.codes[last.active].min() > 0
    assert np.isnan(last.pressure_pa).sum() == np.count_nonzero(last.status & Status.STALE)


@pytest.mark.slow
def test_who_measures_is_unknown_until_it_is_heard(recording: Path) -> None:
    for port, origin in ((IDLE, Origin.SIMULATED), (f"replay://{recording}", Origin.REPLAYED)):
        skin = Skin(port, nodes=16)
        assert skin.source.measured_by is Origin.UNKNOWN
        with skin:
            skin.read()
            assert (skin.source.origin, skin.source.measured_by) == (origin, Origin.SIMULATED)
        assert skin.source.measured_by is Origin.UNKNOWN, "closed, so anybody may be there now"


def test_a_replay_loses_no_frame(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_cdma.skin.BUFFER_S", 0.1)
    decoder = Decoder(nodes=16)
    expected = decoder.feed(b"".join(piece for piece, _ in read_recording(recording)), 0.0)
    expected += decoder.flush()
    with Skin(f"REPLAY://{recording}?speed=0") as skin:  # however it is spelt
        frames = []
        for frame in skin:
            frames.append(frame)
            if len(frames) in (10, 50):
                time.sleep(0.3)
        assert skin.dropped == 0
    # the last frame waits for what follows it: the driver's stream ends, it is not flushed
    assert len(frames) >= len(expected) - 1 > 60
    for found, wanted in zip(frames, expected, strict=False):
        assert (found.sequence, found.t_device) == (wanted.sequence, wanted.t_device)
        for name in ("pressure_pa", "voltage_v", "status", "active", "codes", "doubtful"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_a_program_cannot_change_what_the_decoder_or_the_next_frame_has() -> None:
    with Skin("sim://?scene=idle", nodes=16) as skin:
        frame = skin.read()
        for name in ("pressure_pa", "status", "positions_m", "nodes", "codes"):
            with pytest.raises(ValueError, match="read-only"):
                getattr(frame, name)[0] = 1
        own = frame.pressure_pa.copy()
        own[:] = -1.0
        assert (skin.read().pressure_pa != -1.0).all()


def test_a_skin_that_is_forgotten_gives_its_port_back() -> None:
    def streams() -> int:
        return sum(thread.name.startswith("skin ") for thread in threading.enumerate())

    before = streams()
    skin = Skin("sim://", nodes=16).open()
    skin.read()
    assert streams() == before + 1
    del skin
    gc.collect()
    assert streams() == before


def test_a_decoder_that_cannot_decode_says_so() -> None:
    decoder = Decoder(nodes=16)
    decoder.feed(b"\x01garbage\x00" * 100, t_host=1.0)
    assert decoder.problem is not None and "in 900 bytes" in decoder.problem


def test_a_slow_program_loses_old_frames_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_cdma.skin.BUFFER_S", 0.1)
    with Skin("sim://", nodes=16) as skin:
        first = skin.read()
        wait_for(lambda: skin.dropped)
        waiting, dropped = skin.read(), skin.dropped
        newest = skin.newest()
    assert dropped > 0
    assert waiting.sequence > first.sequence + 1
    assert newest.sequence > waiting.sequence


def test_newest_is_never_the_same_frame_twice() -> None:
    with Skin("sim://", nodes=16) as skin:
        numbers = [skin.newest().sequence for _ in range(10)]
    assert numbers == sorted(set(numbers))


def test_tare_takes_off_what_a_resting_skin_reads() -> None:
    with Skin(f"{IDLE}&mismatch=0.005", nodes=16) as skin:
        tared = None
        while tared is None:
            skin.newest()
            try:
                tared = skin.tare()
            except RestError as error:
                assert "not tared" in str(error)
        assert tared.shape == (16,) and np.abs(tared).max() > 0
        assert np.nanmax(np.abs(skin.read().pressure_pa)) < 500.0  # the very next frame


@pytest.mark.slow
def test_a_replay_is_tared_while_it_waits(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver's thread waits for room among the frames, and must not keep the tare waiting."""
    monkeypatch.setattr("tactile_cdma.skin.BUFFER_S", 0.05)
    with Skin(f"replay://{recording}?speed=0") as skin:
        for _ in range(90):  # 1 s, which a tare asks for
            skin.read()
        time.sleep(0.2)
        assert skin.tare(force=True).shape == (16,)
        assert len(list(skin)) > 20


def test_a_port_that_is_none_and_one_that_says_nothing_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(PortError, match="no such port"):
        Skin(str(tmp_path / "ttyACM9")).open()
    said = pytest.raises(PortError, match=r"no frame for 0\.5 s: ")
    with chattering() as silent, Skin(silent, timeout_s=0.5) as skin, said:
        skin.read()


def test_a_closed_skin_says_so_and_can_be_opened_again() -> None:
    skin = Skin("sim://", nodes=16)
    with pytest.raises(PortError, match="not open"):
        skin.read()
    for _ in range(2):
        with skin:
            assert skin.open() is skin
            assert skin.read().pressure_pa.shape == (16,)
    with pytest.raises(PortError, match="not open"):
        skin.newest()


def test_a_recording_of_another_skin_is_no_empty_one(recording: Path) -> None:
    with (
        Skin(f"replay://{recording}?speed=0", nodes=9, order=24) as skin,
        pytest.raises(PortError, match=r"no frame in it: the digitizer is set to nodes \d+ \(para"),
    ):
        next(iter(skin))


def test_recordings_with_frames_and_empty_ones_end_quietly(recording: Path, tmp_path: Path) -> None:
    """The first though its digitizer is set otherwise in the end."""
    other, both, empty = (tmp_path / f"{name}.skin" for name in ("other", "both", "empty"))
    url = "sim://?scene=moving&order=24&speed=0"
    assert main(["record", url, str(other), "--seconds", "1", "--order", "24"]) == 0
    with Recorder(both, url, 9600, {}) as recorder:
        for path in (recording, other):
            for data, t_host in read_recording(path):
                recorder.write(data, t_host)
    with Recorder(empty, url, 9600, {}) as recorder:
        recorder.write(b"no packets", 0.0)  # one without bytes is refused
    with Skin(f"replay://{both}?speed=0") as skin:
        assert sum(1 for _ in skin) > 100
        with skin._driver.between_frames() as pipeline:  # type: ignore[union-attr]
            assert "order 24 (parameters: 20)" in (pipeline.problem or "")
    with Skin(f"replay://{empty}?speed=0") as skin:
        assert list(skin) == []


STEPPED = "sim://?scene=external&speed=0&threshold=0"  # every node speaks in every frame
BALL = Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.019))  # 1 mm deep


def stepped(port: str = STEPPED) -> Skin:
    skin = Skin(port, nodes=16, contacts=True, timeout_s=PATIENCE_S).open()
    for _ in range(5):
        skin.step()
    return skin


def test_contacts_are_those_of_the_pressed_taxels() -> None:
    with stepped() as skin:
        rest = skin.step()
        assert (rest.touched, rest.untouched) == (False, True)
        assert rest.wrench.tolist() == [0.0] * 6
        for _ in range(3):
            pressed = skin.step(BALL)
    above = pressed.pressure_pa > 1e3
    normal_n = float(pressed.pressure_pa[above] @ skin.layout.areas_m2[above])
    assert (pressed.touched, pressed.untouched) == (True, False)
    assert pressed.contacts is not None and pressed.contacts.taxels[0].tolist() == [5, 6, 9, 10]
    assert np.flatnonzero(above).tolist() == [5, 6, 9, 10] and normal_n > 0.3
    assert pressed.wrench == pytest.approx([0, 0, -normal_n, 0, 0, 0], abs=1e-3)
    assert pressed.contacts.age_s == pytest.approx([2 * 12.8e-3])  # since the first of three frames
    assert pressed.grid.shape == (4, 4) and pressed.grid[2, 1] == pressed.pressure_pa[9]
    assert repr(skin.layout) == "Layout('grid of 4 × 4', 16 taxels)"
    assert len(repr(pressed)) < 80 and len(repr(pressed.contacts)) < 80


def test_a_skin_that_is_blind_in_part_does_not_claim_that_nothing_touches_it() -> None:
    with stepped(f"{STEPPED}&dead=6") as skin:
        unfelt = skin.step(Sphere(radius_m=2e-3, position_m=tuple(skin.layout.positions_m[5])))
        felt = skin.step(BALL)
    assert (unfelt.touched, unfelt.untouched) == (False, False)
    assert np.isnan(unfelt.wrench).all()
    assert (felt.touched, felt.untouched) == (True, False)
    assert felt.contacts is not None and felt.contacts.lower_bound.all()


def test_contacts_that_nobody_asked_for_are_refused_not_empty() -> None:
    with Skin(STEPPED, nodes=16) as skin:
        frame = skin.step()
    for name in ("touched", "untouched", "wrench"):
        with pytest.raises(ParameterError, match="contacts=True"):
            getattr(frame, name)


def test_the_latest_frame_comes_at_once_as_long_as_it_is_of_the_present() -> None:
    with Skin(STEPPED, nodes=16, timeout_s=60.0) as skin:
        assert (
            skin.latest() is None
        )  # no frame passes without a step; else it would wait, and raise
        frame = skin.step()
        assert skin.latest() is frame and skin.latest() is frame
        time.sleep(LATEST_S + 0.1)
        assert skin.latest() is None, "who feels no more does not feel what was last"
        assert skin.latest(max_age_s=None) is frame
    with pytest.raises(PortError, match="not open"):
        skin.latest()


def test_an_async_loop_gets_every_frame_while_other_tasks_run(tmp_path: Path) -> None:
    async def sequences(skin: Skin, many: int) -> list[int]:
        found = []
        async for frame in skin:
            found.append(frame.sequence)
            if len(found) == many:
                break
        return found

    async def both(skin: Skin) -> tuple[list[int], int]:
        task, turns = asyncio.create_task(sequences(skin, 20)), 0
        while not task.done():
            await asyncio.sleep(0.005)
            turns += 1
        return task.result(), turns

    async def cancelled(skin: Skin) -> None:
        """In the very turn in which a frame is told, too."""
        for turn in range(100):
            task = asyncio.create_task(sequences(skin, 10**6))
            await asyncio.sleep(turn * 1e-4)
            task.cancel()
            await asyncio.wait({task}, timeout=1)
            assert task.cancelled()

    with Skin("sim://", nodes=16) as skin:
        found, turns = asyncio.run(both(skin))
        assert found == list(range(found[0], found[0] + 20)) and turns > 2
        asyncio.run(cancelled(skin))
        assert skin.read().sequence > found[-1]
    with Skin(STEPPED, nodes=16, timeout_s=0.3) as skin, pytest.raises(PortError, match="no frame"):
        asyncio.run(sequences(skin, 1))


def test_a_tare_waits_for_what_passes_and_no_longer() -> None:
    idle = "sim://?scene=idle&heartbeat=2"
    with Skin(idle, nodes=16) as skin:  # not read for a second yet
        with pytest.raises(RestError) as early:
            skin.tare(wait_s=0.0)
        assert early.value.reason == Refusal.EARLY
        assert skin.tare(wait_s=10.0).shape == (16,)
    with Skin("sim://?scene=press&heartbeat=2&speed=4", nodes=16) as skin:
        while np.nanmax(skin.newest().pressure_pa, initial=0.0) < 5e3:
            pass
        begun_s = time.monotonic()
        with pytest.raises(RestError, match="not tared") as pressed:
            skin.tare(wait_s=0.3)
        assert pressed.value.reason in (Refusal.LOADED, Refusal.MOVING, Refusal.EARLY)
        assert time.monotonic() - begun_s >= 0.3


def test_a_decoder_finds_the_contacts_of_every_frame() -> None:
    """The fingertip of the scene comes and goes."""
    config = SkinConfig.of({"nodes": 16})
    data = stream(config, "sim://?scene=press&threshold=0", 200)
    frames = Decoder(nodes=16, contacts=True).feed(data, 0.0)
    assert {frame.touched for frame in frames} == {False, True}
    for frame in frames[1:-1]:
        assert frame.touched != frame.untouched
        assert frame.wrench[2] == pytest.approx(-sum(frame.contacts.load_n))


FILE = """
frame_id: torso
patches:
  left: {parameters: {port: "sim://?scene=all", mount_xyz_m: [1.0, 0.0, 0.0], rows: 2, columns: 8}}
  right: {parameters: {port: "sim://?nodes=24", nodes: 24, frame_period_ms: 16.0}}
  away: {parameters: {port: /dev/no_such_port, mount_xyz_m: [0.0, 0.0, 0.0]}}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "body.yaml"
    path.write_text(FILE)
    return path


def test_the_example_of_the_docstring_runs() -> None:
    result = doctest.testmod(sys.modules[Body.__module__])
    assert (result.failed, result.attempted) == (0, 2)


def noted(skin: Skin) -> list[int]:
    """The numbers of the frames that a skin hands over, which on a busy machine have gaps."""
    numbers, waiting = list[int](), skin.waiting

    def give() -> list[Frame]:
        frames = waiting()
        numbers.extend(frame.sequence for frame in frames)
        return frames

    skin.waiting = give  # type: ignore[method-assign]
    return numbers


def test_a_patch_that_is_away_is_missing_and_the_others_lose_nothing(file: Path) -> None:
    with Body(file, contacts=True) as body:
        came = {name: noted(skin) for name, skin in body.skins.items()}
        begun = dropwhile(lambda frame: frame.missing != ("away",), body)  # others may be late
        frames = list(islice(begun, 60))
    assert all("away" in frame.missing for frame in frames)
    last = frames[-1]
    left, right, away = (body.parts[name] for name in ("left", "right", "away"))
    assert (left, right, away) == (slice(0, 16), slice(16, 40), slice(40, 56))
    assert np.array_equal(
        last.pressure_pa[right], last.patches["right"].pressure_pa, equal_nan=True
    )
    assert np.isnan(last.pressure_pa[away]).all() and (last.status[away] == Status.STALE).all()
    assert np.nanmax(last.pressure_pa[left]) > 1e3 and last.patches["left"].touched
    for name in ("left", "right"):
        seen = [frame.patches[name].sequence for frame in frames if name in frame.patches]
        seen = list(dict.fromkeys(seen))
        first = came[name].index(seen[0])
        assert seen == came[name][first : first + len(seen)], "no frame is skipped"
    assert all(b.t_host >= a.t_host for a, b in pairwise(frames))
    assert body.positions_m[left, 0].mean() == pytest.approx(1.0)
    assert np.isnan(body.positions_m[right]).all(), "mounted nowhere"
    assert "missing: away" in repr(last) and len(repr(last)) < 80


def test_a_body_of_which_nothing_comes_names_every_reason(file: Path) -> None:
    with Body(file, only="away", timeout_s=0.3) as body, pytest.raises(PortError) as silent:
        body.read()
    assert "away: " in str(silent.value) and "/dev/no_such_port" in str(silent.value)
    with pytest.raises(BodyError, match="no patch 'lft'"):
        Body(file, only="lft")
    with pytest.raises(PortError, match="not open"):
        body.read()


PRESSED = """
stale_after_s: 0.4
defaults: {parameters: {port: "sim://?scene=external&threshold=0"}}
patches:
  top: {parameters: {mount_xyz_m: [0.0, 0.5, 1.0]}}
  front: {parameters: {mount_xyz_m: [1.0, 0.0, 0.2], mount_rpy_rad: [0.0, 1.5707963267948966, 0.0]}}
"""
DEEP_BALL = Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.018))
"""Presses on the middle of a patch."""


@pytest.fixture
def pressed(tmp_path: Path) -> Iterator[Body]:
    """A body of two patches, which nothing touches yet."""
    (tmp_path / "body.yaml").write_text(PRESSED)
    with Body(tmp_path / "body.yaml", contacts=True, timeout_s=3.0) as body:
        wait_for(lambda: body.read().untouched)
        yield body


def silence(body: Body, *names: str) -> None:
    """Have these patches deliver nothing any more."""
    for name in names:
        body.skins[name].waiting = list  # type: ignore[method-assign]
        body._waiting[name].clear()


def test_contacts_of_a_body_are_where_its_patches_are_mounted(pressed: Body) -> None:
    """By hand: a force along −z at the top, along −x in front, each at a patch's middle."""
    top, front = pressed.skins.values()
    top.press(DEEP_BALL)
    front.press(Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.0175)))
    wait_for(lambda: len(pressed.read().contacts or ()) == 2)
    frame = pressed.read()
    down_n, back_n = (-frame.patches[name].wrench[2] for name in ("top", "front"))
    found = frame.contacts
    assert found is not None and frame.touched and not frame.untouched
    assert back_n > down_n > 1.0
    assert frame.wrench == pytest.approx(
        [-back_n, 0.0, -down_n, -0.5 * down_n, -0.2 * back_n, 0.0], abs=1e-9
    )
    stronger, weaker = found.contacts
    assert (stronger.patch, weaker.patch) == ("front", "top")
    assert stronger.position == pytest.approx([1.0, 0.0, 0.2], abs=1e-9)
    assert weaker.position == pytest.approx([0.0, 0.5, 1.0], abs=1e-9)
    assert stronger.normal == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert stronger.force == pytest.approx([-back_n, 0.0, 0.0], abs=1e-9)
    own = frame.patches["front"].contacts
    assert own is not None and stronger.taxels.tolist() == own.taxels[0].tolist()
    assert (found.taxels_valid, found.taxels_in_service) == (32, 32)


def test_a_patch_that_fell_silent_is_known_in_time_and_claims_nothing(pressed: Body) -> None:
    """It is pressed right after its last frame, which says that nothing touches it."""
    assert pressed.stale_after_s == 0.4
    silence(pressed, "front")
    pressed.skins["front"].press(DEEP_BALL)
    silent_s, frames = time.monotonic(), 0
    while not (frame := pressed.read()).missing:
        assert (frames := frames + 1) * 12.8e-3 < 0.8, "1 s without it"
    assert time.monotonic() - silent_s > 0.3 and frame.missing == ("front",)
    assert not frame.touched and not frame.untouched and np.isnan(frame.wrench).all()
    found = frame.contacts
    assert found is not None and (found.taxels_valid, found.taxels_in_service) == (16, 32)
    pressed.skins["top"].press(DEEP_BALL)
    wait_for(lambda: pressed.read().touched)
    frame = pressed.read()
    assert frame.missing and frame.wrench[2] < -1.0, "a lower bound"
    # Now all are silent: that is said, too, and in the end it is an error.
    silence(pressed, "top")
    begun_s, told = time.monotonic(), list[BodyFrame]()
    with pytest.raises(PortError, match="no frame for 3 s"):
        while True:
            told.append(pressed.read())
    assert time.monotonic() - begun_s > 2.9
    assert len(told) > 3 and all(len(frame.missing) == 2 for frame in told)
    assert not any(frame.touched or frame.untouched for frame in told)
    assert all(np.isnan(frame.pressure_pa).all() for frame in told)
    del pressed.skins["top"].waiting
    assert "top" in pressed.read().patches
    assert Body(pressed.path, stale_after_s=7.0).stale_after_s == 7.0
    for wrong in (0.0, math.nan, "1", 1e9):
        with pytest.raises(ParameterError, match="stale_after_s"):
            Body(pressed.path, stale_after_s=wrong)  # type: ignore[arg-type]


def test_a_patch_without_a_stamp_of_now_is_missing_however_late_it_came(pressed: Body) -> None:
    """As after a pause of the program, in which one patch fell silent and the other one did not."""
    patches = pressed.read().patches
    silence(pressed, *patches)
    for (name, frame), t_s in zip(patches.items(), (1e6, 1e6 + 0.5), strict=True):
        pressed._waiting[name].append(replace(frame, t_host=t_s, stamp_uncertainty_s=1e-3))
    found = pressed.read()
    assert found.missing == ("top",) and not found.untouched
    assert found.t_host == 1e6 + 0.5


def test_contacts_have_the_names_and_values_of_the_message() -> None:
    pytest.importorskip("rclpy")
    from rclpy.serialization import deserialize_message

    from tactile_cdma.messages.cdr import Heading
    from tactile_cdma.msg import TactileContact, TactileContacts
    from tactile_cdma.ros.driver.frames import contacts_message

    ball = Sphere(radius_m=0.005, position_m=(0.009, 0.009, 0.0035))
    with Skin("sim://?scene=external&speed=0&threshold=0&dead=3", contacts=True) as skin:
        frame = [skin.step(DEEP_BALL, ball) for _ in range(3)][-1]
    assert frame.contacts is not None
    message = contacts_message(frame.contacts, frame, "", Heading(0, "skin"), 7)  # type: ignore[arg-type]
    told = deserialize_message(message, TactileContacts)
    assert (frame.contacts.taxels_valid, frame.contacts.taxels_in_service) == (15, 16)
    assert frame.contacts.taxels_valid == told.taxels_valid
    assert frame.contacts.taxels_in_service == told.taxels_in_service
    names = TactileContact.get_fields_and_field_types()
    assert [field.name for field in fields(Contact)] == list(names)
    for found, its in zip(frame.contacts.contacts, told.contacts, strict=True):
        for name in names:
            value, expected = getattr(found, name), getattr(its, name)
            if hasattr(expected, "x"):
                expected = [expected.x, expected.y, expected.z]
            if isinstance(value, np.ndarray | float):
                value, expected = pytest.approx(value, rel=1e-6), list(np.atleast_1d(expected))
                expected = expected if len(expected) > 1 or name == "taxels" else expected[0]
            assert expected == value, name
