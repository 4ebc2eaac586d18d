# SPDX-License-Identifier: Apache-2.0

"""The public interface: live frames, bytes to frames, errors, the examples of its documents."""

import doctest
import gc
import sys
import threading
import time
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest

import tactile_cdma
from tactile_cdma import Decoder, Frame, Origin, Skin, Status, read_recording
from tactile_cdma.base.errors import ParameterError, PortError, RestError, SpecError
from tactile_cdma.commands.cli import main
from tactile_cdma.recording.recording_file import Recorder
from tactile_cdma.sim.options import SimOptions
from test.support import simulated
from test.support.boards import chattering
from test.support.programs import run_python
from test.support.waiting import wait_for

pytestmark = pytest.mark.xdist_group("public_skin")
ROOT = Path(__file__).resolve().parents[3]
IDLE = "sim://?scene=idle&heartbeat=2"  # every node speaks early, so that no taxel is awaited


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("public_skin") / "touch.skin"
    return simulated.recording(path, SimOptions(scene="moving", seed=3), 2.0)


def decoded(path: Path) -> list[Frame]:
    decoder = Decoder(nodes=16)
    data = b"".join(piece for piece, _ in read_recording(path))
    return decoder.feed(data, 0.0) + decoder.flush()


def assert_same(some: list[Frame], others: list[Frame]) -> None:
    """In all but the host's time."""
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        assert (one.sequence, one.t_device) == (other.sequence, other.t_device)
        for name in ("pressure_pa", "voltage_v", "status", "active", "codes", "doubtful"):
            assert np.array_equal(
                getattr(one, name), getattr(other, name), equal_nan=name.endswith(("_pa", "_v"))
            )


def test_every_public_name_is_there_and_nothing_else_is_loaded_before() -> None:
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


def test_examples_of_the_docstrings_run() -> None:
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


def test_a_replay_gives_every_frame_to_a_slow_program_and_ends(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactile_cdma.skin.BUFFER_S", 0.1)
    expected = decoded(recording)
    with Skin(f"REPLAY://{recording}?speed=0") as skin:  # however it is spelt
        frames = []
        for frame in skin:
            frames.append(frame)
            if len(frames) in (10, 50):
                time.sleep(0.3)
        assert skin.dropped == 0
    # the last frame waits for what follows it: the driver's stream ends, it is not flushed
    assert_same(frames, expected[: len(frames)])
    assert len(frames) >= len(expected) - 1 > 60


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


def test_a_slow_program_loses_the_oldest_frames_and_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
def test_a_replay_can_be_tared_while_it_waits_for_the_program(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The driver's thread waits for room among the frames, and must not keep the tare waiting."""
    monkeypatch.setattr("tactile_cdma.skin.BUFFER_S", 0.05)
    with Skin(f"replay://{recording}?speed=0") as skin:
        for _ in range(90):  # 1 s, which a tare asks for
            skin.read()
        time.sleep(0.2)
        assert skin.tare(force=True).shape == (16,)
        assert len(list(skin)) > 20


def test_wrong_parameters_are_refused_by_name_and_limit() -> None:
    with pytest.raises(ParameterError, match="did you mean 'nodes'"):
        Skin("sim://", node=16)
    with pytest.raises(ParameterError, match=r"bits is 99 bit; it must lie within 8…16"):
        Decoder(bits=99)
    with pytest.raises(SpecError):
        Skin("sim://", nodes=16, frame_period_ms=1.0)


def test_paths_and_numpy_s_numbers_are_parameters_too() -> None:
    skin = Skin(
        Path("/dev/ttyACM9"),  # type: ignore[arg-type]
        nodes=np.int64(16),  # type: ignore[arg-type]
        mount_xyz_m=[0.0, 0.0, 0.1],
    )
    assert skin.port == "/dev/ttyACM9"
    assert skin.config.spec.nodes == 16


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


def test_a_recording_that_had_frames_and_an_empty_one_end_quietly(
    recording: Path, tmp_path: Path
) -> None:
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
