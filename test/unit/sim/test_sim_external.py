# SPDX-License-Identifier: Apache-2.0

"""sim://?scene=external: what a program presses, through sensors, ADC, line and decoder."""

import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_cdma import Frame, PortError, Skin, SpecError, TactileError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves
from tactile_cdma.sim import Box, Cylinder, Foundation, Indenter, SkinBatch, Sphere
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.pressing import press
from tactile_cdma.sim.sensor import SensorModel
from tactile_cdma.wire.messages import Start
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.calibrations import write_calibration
from test.support.programs import run_python
from test.support.waiting import PATIENCE_S

STEPPED = "sim://?scene=external&speed=0"
LAYOUT = Layout.grid(16, 4, 4, 7e-3, 7e-3)
COVER = Foundation(LAYOUT.positions_m, LAYOUT.normals, LAYOUT.areas_m2)
BALL = Sphere(radius_m=0.02, position_m=(1e-3, -2e-3, 0.018))
LSB_PA = 3.3 / 1024 / 0.033e-3
"""One code in the first stage of the sensor's curve: 0.033 V per kPa."""


def stepped(query: str = "", **parameters: float) -> Skin:
    return Skin(f"{STEPPED}&{query}", nodes=16, **parameters)


def test_pressures_come_back_within_the_resolution_of_the_converter() -> None:
    with stepped("threshold=0&noise=0") as skin:
        for thing in (
            BALL,
            Box(size_m=(0.012, 0.02, 0.01), position_m=(0, 0, 4e-3), stiffness_pa_per_m=3e7),
            Cylinder(
                radius_m=0.01, length_m=0.02, position_m=(0, 0, 9e-3), orientation_xyzw=(1, 0, 0, 1)
            ),
        ):
            true_pa = COVER.pressure_pa([thing])
            assert 3e3 < true_pa.max() < 50e3
            frame = skin.step(thing)
            assert np.abs(frame.pressure_pa - true_pa).max() <= 0.51 * LSB_PA
        assert not skin.step().pressure_pa.any(), "released"


def test_a_curved_skin_is_pressed_in_its_own_frame() -> None:
    path = Path(__file__).resolve().parents[3] / "config" / "layouts" / "cylinder.yaml"
    with Skin(f"{STEPPED}&threshold=0", layout_file=path, nodes=72, frame_period_ms=40.0) as skin:
        layout = skin.layout
        cover = Foundation(layout.positions_m, layout.normals, layout.areas_m2)
        for taxel in (0, 17, 71):
            centre_m = layout.positions_m[taxel] + 0.0185 * layout.normals[taxel]
            ball = Sphere(radius_m=0.02, position_m=centre_m.tolist())
            true_pa, frame = cover.pressure_pa([ball]), skin.step(ball)
            assert np.argmax(frame.pressure_pa) == taxel
            assert np.abs(frame.pressure_pa - true_pa).max() <= 0.51 * LSB_PA


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("rows=2&columns=8", "option rows is 2, but 4 of the driver's skin, grid of 4 × 4"),
        ("pitch_mm=7,5", "option pitch_mm is [7, 5], but 7 of"),
        ("layout={path}", "is another skin than the driver's"),
    ],
)
def test_a_url_of_another_skin_than_the_drivers_is_refused(
    query: str, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "skin.yaml"
    head = "schema: tactile_cdma/layout\nversion: 1\nshape: grid\nrows: 4\ncolumns: 4\n"
    path.write_text(head + "pitch_mm: 7.5\n")
    with pytest.raises(PortError, match=re.escape(words)):
        stepped(query.format(path=path)).open()
    with stepped("rows=4&pitch_mm=7"):
        pass
    path.write_text(head + "pitch_mm: 7\n")
    with stepped(f"layout={path}"):
        pass


@pytest.mark.parametrize("shape", ["grid", "list"])
@pytest.mark.parametrize("axis", [0, 1])
def test_slip_is_felt_across_columns_as_across_rows(shape: str, axis: int, tmp_path: Path) -> None:
    """A fingertip with columns 6.0 mm and rows 3.6 mm apart; the ball moves at 20 mm/s."""
    tip = Layout.grid(24, 6, 4, (6e-3, 3.6e-3), 3e-3)
    parameters = {"rows": 6, "columns": 4, "pitch_mm": [6.0, 3.6], "taxel_mm": 3.0}
    if shape == "list":
        places = (1e3 * tip.positions_m).round(2).tolist()
        taxels = [f"  - {{position_mm: {place}, node: {n}}}" for n, place in enumerate(places, 1)]
        path = tmp_path / "tip.yaml"
        head = ["schema: tactile_cdma/layout", "version: 1", "shape: list", "taxels:"]
        path.write_text("\n".join(head + taxels))
        parameters = {"layout_file": str(path)}
    with Skin(
        f"{STEPPED}&threshold=0", nodes=24, frame_period_ms=16.0, contacts=True, **parameters
    ) as skin:
        assert skin.layout.areas_m2.sum() == pytest.approx(24 * 21.6e-6)
        skin.step()
        speeds_mm_s = []
        for frame in range(32):
            place_m = np.roll([(frame - 16) * 20e-3 * 16e-3, 0.0], axis)
            ball = Sphere(radius_m=0.01, position_m=(*place_m, 9e-3))
            found = skin.step(ball).contacts
            assert found is not None
            assert len(found.ids) == 1
            speeds_mm_s.append(1e3 * found.velocity_m_s[0, axis])
    assert np.mean(speeds_mm_s[8:]) == pytest.approx(20, rel=0.1)


@pytest.mark.parametrize("period_ms", [14.0, 14.05, 15.0])
def test_a_step_returns_though_its_frame_fills_the_period(
    period_ms: float, caplog: pytest.LogCaptureFixture
) -> None:
    """What follows a frame shows that it is over; after the frame of a step nothing follows."""
    with Skin(
        f"{STEPPED}&threshold=0", nodes=24, frame_period_ms=period_ms, timeout_s=PATIENCE_S
    ) as skin:
        frames = [skin.step(BALL) if step % 2 else skin.step() for step in range(6)]
    assert [frame.sequence for frame in frames] == list(range(6))
    assert [frame.pressure_pa.max() > 5e3 for frame in frames] == [False, True] * 3
    assert not any(frame.status.any() or frame.doubtful.any() for frame in frames)
    assert ("set frame_period_ms to 15 or more" in caplog.text) is (period_ms < 15)


def test_what_is_beyond_the_sensors_is_clamped_and_flagged() -> None:
    with stepped("threshold=0") as skin:
        box = Box(size_m=(0.1, 0.1, 0.1), position_m=(0, 0, 0.03), stiffness_pa_per_m=1e7)
        frame = skin.step(box)
    assert (frame.pressure_pa == 140e3).all()
    assert (frame.status & 2).all()


def course(pause_s: float, query: str) -> list[Frame]:
    """The same presses at another pace of the program."""
    frames = []
    with stepped(query) as skin:
        for step in range(40):
            if step % 8 == 3:
                time.sleep(pause_s)
            things: list[Indenter] = [BALL] if step % 10 > 5 else []
            frames.append(skin.step(*things))
    return frames


@pytest.mark.parametrize("query", ["", "seed=3&sensor=paper&threshold=0&stretch=0.1"])
def test_the_same_steps_give_the_same_frames_at_any_pace(query: str) -> None:
    once, slowly = course(0.0, query), course(0.05, query)
    for a, b in zip(once, slowly, strict=True):
        assert a.sequence == b.sequence
        assert np.array_equal(a.codes, b.codes)
        assert np.array_equal(a.status, b.status)
        assert np.array_equal(a.pressure_pa, b.pressure_pa, equal_nan=True)
    assert [frame.sequence for frame in once] == list(range(40))
    assert once[-1].t_device - once[0].t_device == pytest.approx(39 * 12.8e-3, abs=1e-3)


def test_a_step_shows_in_its_own_frame_after_silent_ones() -> None:
    """Silent frames are sent with the next one; none may be computed before it is pressed."""
    with stepped("heartbeat=0&noise=0") as skin:
        assert not skin.step().active.any()
        assert skin.step().active.all(), "all are asked to speak, once"
        for _ in range(2):
            assert not skin.step().active.any()
        assert skin.step(BALL).active.any()
        assert skin.step().active.any(), "their release is told, once"
        assert not skin.step().active.any()


def test_a_pause_longer_than_the_drivers_patience_begins_no_new_stream() -> None:
    """In which node 3, that has died, would speak again."""
    with stepped("threshold=0&dead=3&dead_after=0.03") as skin:
        spoken = [bool(skin.step(BALL).active[2]) for _ in range(5)]
        assert (spoken[0], spoken[-1]) == (True, False)
        time.sleep(1.3)
        after = skin.step(BALL)
    assert after.sequence == 5
    assert not after.active[2]


def test_frames_wait_for_steps() -> None:
    with stepped() as skin:
        skin.step()
        skin.timeout_s = 0.3
        with pytest.raises(PortError, match=r"frames pass one step\(\) at a time"):
            skin.read()
        with pytest.raises(PortError, match=r"speed is 0, .* step\(\*objects\) makes one"):
            skin.press(BALL)
        skin.timeout_s = PATIENCE_S
        assert skin.step(BALL).sequence == 1


def test_a_step_whose_frame_is_rejected_says_why() -> None:
    """An amplifier with too little room for the sum of all nodes."""
    box = Box(size_m=(0.1, 0.1, 0.1), position_m=(0, 0, 0.049))
    with (
        stepped("threshold=0&rail=0.5", timeout_s=0.5) as skin,
        pytest.raises(PortError, match="frames are rejected, mostly with the line at a rail"),
    ):
        skin.step(box)


def test_what_is_asked_for_ahead_passes_in_turn() -> None:
    """A program that does not wait for its frames loses none of its objects."""
    depths_m = np.arange(3, 11) * 1e-4
    balls = [Sphere(radius_m=0.02, position_m=(0, 0, 0.02 - depth)) for depth in depths_m]
    with stepped("threshold=0&noise=0") as skin:
        waited_pa = [skin.step(ball).pressure_pa for ball in balls]
        driver = skin._running()
        for ball in balls:
            press(driver, [ball], frames=1)
        ahead_pa = [skin.read().pressure_pa for _ in balls]
    np.testing.assert_array_equal(ahead_pa, waited_pa)
    assert np.unique(np.max(ahead_pa, axis=1)).size == len(balls)


def test_what_is_no_object_is_refused() -> None:
    with stepped() as skin:
        for wrong in ([BALL], "ball"):
            with pytest.raises(PortError, match="objects are given one by one"):
                skin.step(wrong)  # type: ignore[arg-type]
        assert skin.step(BALL).pressure_pa.any()


def test_at_another_pace_it_is_pressed_from_the_next_frame_on() -> None:
    """Twenty times faster than real time."""
    with Skin("sim://?scene=external&speed=20&threshold=0", nodes=16) as skin:
        assert not skin.read().pressure_pa.any()
        skin.press(BALL)
        pressed = next(frame for frame in skin if frame.pressure_pa.any())
        assert np.abs(pressed.pressure_pa - COVER.pressure_pa([BALL])).max() <= 0.51 * LSB_PA
        skin.press()
        assert next(frame for frame in skin if not frame.pressure_pa.any())
        with pytest.raises(PortError, match="speed is 20, so frames come by themselves"):
            skin.step()


def test_other_ports_are_not_pressed() -> None:
    with Skin("sim://?scene=press", nodes=16) as skin, pytest.raises(PortError, match="external"):
        skin.press(BALL)
    with pytest.raises(PortError, match="not open"):
        stepped().press(BALL)
    with pytest.raises(SpecError, match="the scene is 'press'"):
        VirtualDigitizer(SimOptions(scene="press")).press([BALL])


def test_the_example_feels_what_it_presses() -> None:
    example = Path(__file__).resolve().parents[3] / "examples" / "press_a_skin.py"
    done = run_python(example)
    assert (done.returncode, done.stderr) == (0, "")
    lines = [re.findall(r"[\d.]+(?= N| mm)", line) for line in done.stdout.splitlines()]
    depth_mm, pressed_n, felt_n, felt_mm, true_mm = np.array(lines, dtype=float).T
    assert (len(lines), depth_mm[-1]) == (13, 3.0)
    assert felt_n == pytest.approx(pressed_n, abs=0.04)
    assert felt_mm == pytest.approx(true_mm, abs=0.5)


@pytest.mark.parametrize("query", ["timing=gap", "start_phase=0.3"])
def test_frames_without_marks_cannot_be_stepped(query: str) -> None:
    with pytest.raises(SpecError, match="leave out timing=gap and start_phase"):
        SimOptions.from_url(f"{STEPPED}&{query}")


def test_a_host_that_wants_no_marks_is_refused() -> None:
    with (
        Skin(STEPPED, nodes=16, timing="gap", timeout_s=2.5) as skin,
        pytest.raises(PortError, match="refused"),
    ):
        skin.step()


@pytest.mark.parametrize("query", ["", "integrated=1", "threshold=0", "scramble=1"])
def test_steps_give_the_packets_of_the_untouched_skin(query: str) -> None:
    """Frame by frame the same bytes as of a stream that runs, and no more than were asked for."""

    def sent(scene: str, frames: int) -> bytes:
        options = SimOptions.from_url(f"sim://?scene={scene}&speed=0&{query}")
        digitizer, data = VirtualDigitizer(options, clock=lambda: 0.0), b""
        digitizer.receive(PacketWriter().encode(Start()))
        for _ in range(frames):
            if options.stepped:
                digitizer.press([], 1)
            digitizer.advance(1 << 20 if options.stepped else 1)
            data += digitizer.take(1 << 30)
        return data

    stepwise, running = sent("external", 100), sent("idle", 1000)
    assert len(running) > len(stepwise)
    assert running.startswith(stepwise)
    packets = PacketParser().feed(stepwise)
    assert sum(getattr(packet, "sync", False) for packet in packets) == 100


BOARD = AdcScale(12, 5.0)
"""Of the user's own nodes: 12 bits, 5 V."""


@pytest.fixture
def own(tmp_path: Path) -> dict[str, Any]:
    """Parameters of a user's own FSRs: rising voltages, each taxel with its own curve."""
    rng = np.random.default_rng(2)
    pressure_pa = np.array([0.0, 5e3, 2e4, 6e4])[:, None] * rng.uniform(0.8, 1.2, 16)
    rises_v = np.array([0.4, 1.0, 2.0, 1.1])[:, None] * rng.uniform(0.8, 1.0, 16)
    curves = Curves(pressure_pa, rises_v.cumsum(axis=0))
    calibration = Calibration(curves, np.zeros(16, bool))
    write_calibration(tmp_path / "own.yaml", calibration, BOARD)
    rising = {"v0_v": 0.2, "sensitivity1_v_per_kpa": -0.05, "sensitivity2_v_per_kpa": -0.01}
    file = {"calibration_file": str(tmp_path / "own.yaml"), "range_kpa": 70.0}
    return {"nodes": 16, "bits": 12, "vref_v": 5.0, **rising, **file}


def test_a_user_s_own_sensors_read_what_presses_on_them(
    own: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    """In the chain and in the batch, code by code; other sensors are told by both."""
    port = "sim://?scene=external&speed=0&threshold=0&noise=0"
    mine = f"{port}&calibration={own['calibration_file']}"
    pressed_pa = COVER.pressure_pa([BALL])
    assert pressed_pa.max() > 5e3
    with Skin(mine, drift_pa_per_min=0.0, **own) as skin:
        batch = SkinBatch(skin.config, 1, mine, delay_frames=0)
        state = batch.begin(np.zeros(()))
        for _ in range(3):
            frame = skin.step(BALL)
            state, ours = batch.step(state, pressed_pa[None])
            assert frame.pressure_pa == pytest.approx(pressed_pa, abs=100)
            assert ours.codes[0].tolist() == frame.codes.tolist()
            assert ours.pressure_pa[0].tolist() == frame.pressure_pa.tolist()
    assert caplog.text == ""
    with Skin(port, **own) as skin:
        wrong_pa = skin.step(BALL).pressure_pa
        assert "simulated sensors have another curve" in caplog.text
        caplog.clear()
        SkinBatch(skin.config, 1, port)
        assert "simulated sensors have another curve" in caplog.text
    assert wrong_pa != pytest.approx(pressed_pa, rel=0.5, abs=500)


def test_a_calibration_of_the_simulated_sensors_is_theirs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Sensors that differ a little from their calibration are those that it was made of."""
    curves = SensorModel(mismatch=0.1, seed=3).curves(16)
    file = tmp_path / "made.yaml"
    write_calibration(file, Calibration(curves, np.zeros(16, bool)), AdcScale())
    url = "sim://?scene=external&speed=0&mismatch=0.1&seed="
    for seed in (3, 4):
        with Skin(f"{url}{seed}", nodes=16, calibration_file=str(file)) as skin:
            skin.step(BALL)
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("calibration=none.yaml", "none.yaml: .*no such file|No such file"),
        ("calibration={own}&mismatch=0.1", "leave out mismatch"),
        ("calibration={own}&sensor=fsr", "sensor=fsr"),
    ],
)
def test_a_calibration_that_cannot_be_the_sensors_is_refused(
    query: str, said: str, own: dict[str, Any]
) -> None:
    url = f"sim://?{query.format(own=own['calibration_file'])}"
    with pytest.raises(TactileError, match=said):
        SkinBatch(SkinConfig.of({"nodes": 16}), 1, url)
    with pytest.raises(SpecError, match="is for 16 nodes, the skin has 9"):
        SkinBatch(SkinConfig.of({"nodes": 9}), 1, f"sim://?calibration={own['calibration_file']}")


@pytest.mark.parametrize(
    ("options", "parameters", "is_told"),
    [
        ("", {}, False),
        ("&sensor=paper", {"bits": 12, "v0_v": 3.3, "sensitivity1_v_per_kpa": 0.033}, False),
        ("&sensor=fsr", {}, True),
        ("", {"vref_v": 5.0}, True),
        ("", {"sensitivity1_v_per_kpa": 0.01, "sensitivity2_v_per_kpa": 0.002}, True),
    ],
)
def test_sensors_of_another_curve_than_the_driver_s_are_told(
    options: str, parameters: dict[str, Any], is_told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with Skin(f"sim://?scene=external&speed=0&threshold=0{options}", **parameters) as skin:
        force_n = skin.step(BALL).pressure_pa @ skin.layout.areas_m2
    assert ("simulated sensors have another curve" in caplog.text) == is_told
    assert (
        force_n == pytest.approx(COVER.pressure_pa([BALL]) @ LAYOUT.areas_m2, rel=0.05)
    ) != is_told
