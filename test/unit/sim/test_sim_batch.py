# SPDX-License-Identifier: Apache-2.0

"""SkinBatch against the whole chain: simulated nodes, line, digitizer, decoder, frame by frame."""

import sys
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma import ParameterError, SpecError
from tactile_cdma.base.errors import MissingPackageError
from tactile_cdma.config.skin_config import FRAME_PARAMETERS, SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.poses import Pose
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves
from tactile_cdma.sim import Box, Capsule, Cylinder, Ellipsoid, Foundation, Indenter, Sphere
from tactile_cdma.sim.batch import BatchCover, BatchFrame, SkinBatch
from tactile_cdma.sim.batch.skin_batch import LEFT_OUT
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.indenters import _step_m
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import OPTIONS, Setup, SimOptions
from tactile_cdma.sim.scene import SkinGeometry
from test.support.batch_options import OF_THE_LINE, ONE_BY_ONE
from test.support.calibrations import write_calibration

pytest.importorskip("array_api_compat", reason="the extra [learn] is not installed")
array_api_strict = pytest.importorskip("array_api_strict")

LAYOUTS = Path(__file__).resolve().parents[3] / "config" / "layouts"
CYLINDER = {"nodes": 72, "layout_file": str(LAYOUTS / "cylinder.yaml"), "frame_period_ms": 40.0}
SCENES = "presses", "cycles"
STALE = 1 | 8


def chain(options: SimOptions, config: SkinConfig, count: int) -> list[TactileFrame]:
    """What a driver decodes of the first frames of a noise-free line."""
    digitizer, pipeline = VirtualDigitizer(options), Pipeline(config)
    digitizer.receive(Session(config).open())
    frames: list[TactileFrame] = []
    while len(frames) < count:
        digitizer.advance(1 << 16)
        frames += pipeline.feed(digitizer.take(1 << 20), 0.0)
    assert [frame.sequence for frame in frames] == list(range(len(frames)))
    return frames[:count]


def pressures(options: SimOptions, config: SkinConfig, count: int) -> np.ndarray:
    """What touches the taxels in these frames, (count, t), Pa."""
    node = np.maximum(config.layout.nodes - 1, 0)
    frames = islice(truth(options, options.setup(Setup(config.spec))), count)
    return np.array([frame.pressure_pa[node] for frame in frames])


CASES = {
    "the paper's": ({}, ""),
    "lag and hysteresis": (
        {"nodes": 24, "rows": 4, "columns": 6, "chip_us": 20.0, "frame_period_ms": 10.0},
        "sensor=paper&heartbeat=11",
    ),
    "a part of a cylinder, dead and stuck nodes": (
        {**CYLINDER, "stale_after_s": 0.5},
        "dead=3,17&dead_after=1&stuck=5&mismatch=0.05&threshold=2&heartbeat=9",
    ),
    "rising voltages of 12 bits, by the wrong curve": (
        {"nodes": 12, "bits": 12, "rows": 3, "columns": 4},
        "sensor=fsr&threshold=20",
    ),
    "in the gap, all talk": (
        {"nodes": 9, "timing": "gap", "samples_per_chip": 4, "frame_period_ms": 14.0},
        "threshold=0&dead=1",
    ),
    "no heartbeats, integrated chips": (
        {"nodes": 30, "samples_per_chip": 1, "frame_period_ms": 25.0, "stale_after_s": 0.79},
        "heartbeat=0&threshold=3",
    ),
    "words that have changed": ({"nodes": 9}, "sensor=paper&speaks=change&threshold=2"),
}  # fmt: skip


@pytest.mark.parametrize(("parameters", "url"), CASES.values(), ids=CASES)
def test_the_same_frames_as_the_whole_chain(parameters: dict[str, object], url: str) -> None:
    count, url = 120, f"sim://?noise=0&{url}"
    config = SkinConfig.of({"drift_pa_per_min": 0.0, "stale_after_s": 1.0} | parameters)
    batch = SkinBatch(config, len(SCENES), url, delay_frames=0)
    options = [SimOptions.from_url(f"{url}&speed=0&scene={scene}") for scene in SCENES]
    pressed_pa = np.stack([pressures(each, config, count) for each in options], axis=1)
    published = [chain(each, config, count) for each in options]
    # The simulator's sensors have felt what they feel first since ever.
    state = batch.begin(np.zeros(()), heard=False)._replace(lagged_pa=pressed_pa[0])
    node = np.maximum(config.layout.nodes - 1, 0)
    unseen = int(config.timing == "gap")  # no gap is seen before the first frame
    said = silent = 0
    for number in range(count):
        state, frame = batch.step(state, pressed_pa[number])
        for env, frames in enumerate(published if number >= unseen else ()):
            readings, words = frames[number - unseen].readings, frames[number - unseen].words
            assert np.array_equal(frame.active[env], words.active[node]), (env, number)
            # Without marks a frame of equal words may be in doubt, until the raster is learnt.
            sure = readings.status & 4 == 0
            assert sure.all() or unseen
            spoke = frame.active[env] & sure
            assert np.array_equal(frame.codes[env][spoke], words.codes[node][spoke])
            assert np.array_equal(frame.status[env][sure], readings.status[sure]), (env, number)
            theirs_pa = readings.pressure_pa[sure]
            assert np.array_equal(frame.pressure_pa[env][sure], theirs_pa, equal_nan=True)
            said, silent = said + spoke.sum(), silent + (~spoke).sum()
    assert said > 500
    assert silent > 200 or "threshold=0" in url


def course(batch: SkinBatch, kind: object, envs: int = 3, frames: int = 40) -> list[BatchFrame]:
    """The frames of random loads, in arrays of a kind."""
    rng, state, seen = np.random.default_rng(1), batch.begin(kind), []
    asarray = np.asarray if isinstance(kind, np.ndarray) else array_api_strict.asarray
    for _ in range(frames):
        pressed_pa = rng.uniform(-1e4, 1.6e5, (envs, batch.taxels))
        deviates = rng.standard_normal(pressed_pa.shape)
        state, frame = batch.step(state, asarray(pressed_pa), asarray(deviates))
        seen.append(frame)
    return seen


def test_rests_follow_drift_as_in_the_simulator() -> None:
    """In frames of a minute, in which a rest follows by 1 LSB; and not where it is faster."""
    config = SkinConfig.of({"nodes": 9, "samples_per_chip": 1, "frame_period_ms": 6e4})
    batch = SkinBatch(config, 1, url := "sim://?heartbeat=0", delay_frames=0)

    def drifts(t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
        return np.linspace(20.0, 500.0, 9) * t_s / 60

    sent = truth(SimOptions.from_url(url), Setup(config.spec), scene=drifts)
    state, shares = batch.begin(np.zeros(())), np.zeros(9)
    for frame in islice(sent, 200):
        state, found = batch.step(state, frame.pressure_pa[None])
        assert np.array_equal(found.active[0], frame.active), frame.number
        shares += frame.active / 200
    assert (shares[:2] < 0.5).all() and (shares[3:] > 0.9).all()


@pytest.fixture
def own(tmp_path: Path) -> str:
    """A calibration file with more corners than the simulator's curve, of rising voltages."""
    pressure_pa = np.array([0.0, 5e3, 2e4, 6e4, 1e5])[:, None] + np.zeros(24)
    voltage_v = np.array([0.4, 1.0, 2.0, 2.5, 2.9])[:, None] + np.linspace(0, 0.1, 24)
    calibration = Calibration(Curves(pressure_pa, voltage_v), np.zeros(24, bool))
    write_calibration(tmp_path / "own.yaml", calibration, AdcScale(10, 3.3))
    return str(tmp_path / "own.yaml")


def alike(mine: BatchFrame, whole: BatchFrame, env: int) -> bool:
    """Whether the only skin of one batch is as one of another's."""
    pairs = zip(mine, whole, strict=True)
    return all(np.array_equal(a[0], b[env], equal_nan=a.dtype.kind == "f") for a, b in pairs)


@pytest.mark.parametrize("option", ONE_BY_ONE)
def test_each_environment_has_the_skin_of_its_own_url(option: str, own: str) -> None:
    """Bit for bit as in a batch of its own, and another one than beside it; reset exchanges it."""
    urls = [f"sim://?{query.format(own=own)}" for query in ONE_BY_ONE[option]]
    config = SkinConfig.of({"nodes": 24, "rows": 4, "columns": 6, "frame_period_ms": 16.0})
    rng, loads = np.random.default_rng(4), np.random.default_rng(5)
    both = SkinBatch(config, 2, urls, delay_frames=1, tared=True)
    other = SkinBatch(config, 2, urls[::-1], delay_frames=1, tared=True)
    singles = [SkinBatch(config, 1, url, delay_frames=1, tared=True) for url in urls]
    state, states = both.begin(np.zeros(())), [each.begin(np.zeros(())) for each in singles]
    fresh = other.begin(np.zeros(()))
    places, differ = [0, 1], False
    for number in range(80):
        if number == 40:  # the first environment has the second one's skin from here on
            state = both.reset(state, fresh, np.array([True, False]))
            places[0] = 1
            states.append(singles[1].begin(np.zeros(())))
        if number % 10 == 0:
            pressed_pa = np.repeat(loads.uniform(0, 8e4, (1, 24)), 2, axis=0)
        deviates = np.repeat(rng.standard_normal((1, 24)), 2, axis=0)
        state, frame = both.step(state, pressed_pa, deviates)
        for env, place in enumerate(places):
            kept = 2 if number >= 40 and env == 0 else place
            states[kept], mine = singles[place].step(states[kept], pressed_pa[:1], deviates[:1])
            assert alike(mine, frame, env), (number, env)
        differ |= number < 40 and any(
            not np.array_equal(a[0], a[1], equal_nan=a.dtype.kind == "f") for a in frame
        )
    assert differ


def test_many_options_are_of_each_environment_and_the_others_are_refused() -> None:
    chips = {*FRAME_PARAMETERS, "chip_us", "frame_period_ms", "sign_seed", "timing", "sync_wire"}
    chips |= {"samples_per_chip", "integrated", "amplitude_mv"}  # no faults: how words are sent
    skin = {"rows", "columns", "pitch_mm", "layout"}  # the driver's, and compared with that
    rest = {option.name for option in OPTIONS} - chips - skin - {"speed"}
    assert rest == {*ONE_BY_ONE, *LEFT_OUT} and not {*ONE_BY_ONE} & {*LEFT_OUT}


def test_urls_are_one_or_as_many_as_environments() -> None:
    config = SkinConfig.of({})
    for urls in (["sim://"] * 2, [], ["sim://", 3, "sim://"], {"sim://"}):
        with pytest.raises(ParameterError, match="simulator"):
            SkinBatch(config, 3, urls)  # type: ignore[arg-type]
    with pytest.raises(SpecError, match="does not model"):
        SkinBatch(config, 2, ["sim://", "sim://?rail=2"])


def test_any_library_of_the_standard_gives_the_same_arrays() -> None:
    config = SkinConfig.of({"nodes": 24, "rows": 4, "columns": 6, "frame_period_ms": 16.0})
    url = "sim://?sensor=paper&mismatch=0.05&sensor_noise=0.01&dead=2"
    batch = SkinBatch(config, 3, [url, f"{url}&hysteresis=3&threshold=0", "sim://?heartbeat=0"])
    kinds = np.zeros(()), array_api_strict.zeros(())
    for ours, theirs in zip(*(course(batch, kind) for kind in kinds), strict=True):
        assert all(isinstance(array, array_api_strict.asarray(0).__class__) for array in theirs)
        for mine, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(mine, np.asarray(other))


def test_frames_come_late_by_what_the_line_takes_and_environments_end_alone() -> None:
    config = SkinConfig.of({"frame_period_ms": 12.8})
    batch = SkinBatch(config, 2, "sim://?threshold=0")
    assert batch.delay_frames == 1, "10 ms of code, the tail of a frame and publishing"
    assert SkinBatch(SkinConfig.of({"frame_period_ms": 10.0}), 1).delay_frames == 2
    fresh = state = batch.begin(np.zeros(()))
    loads_pa = 10e3 * np.arange(1.0, 6.0)
    felt_pa = []
    for load_pa in loads_pa:
        if load_pa == 40e3:
            state = batch.reset(state, fresh, np.array([False, True]))
        state, frame = batch.step(state, np.full((2, 16), load_pa))
        felt_pa.append(frame.pressure_pa.mean(axis=1))
    assert np.abs(np.array(felt_pa)[:, 0] - [0, 10e3, 20e3, 30e3, 40e3]).max() < 50
    assert np.abs(np.array(felt_pa)[:, 1] - [0, 10e3, 20e3, 0, 40e3]).max() < 50
    assert state.number.tolist() == [[5], [2]]


def test_a_dead_node_is_no_zero() -> None:
    """Dead from the start, and where the pressure of a frame is NaN, under a load."""
    config = SkinConfig.of({"stale_after_s": 0.1})
    batch = SkinBatch(config, 1, "sim://?dead=3&threshold=0", delay_frames=0)
    state = batch.begin(np.zeros(()))
    load_pa = np.full((1, 16), 20e3)
    load_pa[0, 7] = np.nan
    for number in range(20):
        state, frame = batch.step(state, load_pa)
        gone = [2, 7] if number > 6 else [2]
        assert np.flatnonzero(np.isnan(frame.pressure_pa[0])).tolist() == gone
        assert (frame.status[0, gone] == STALE).all()
    assert not frame.active[0, [2, 7]].any()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_no_word_and_is_forgotten(wrong: float) -> None:
    """Neither a pressure nor a deviate that is none, of which lag and hysteresis have memories."""
    config = SkinConfig.of({"stale_after_s": 0.1})
    batch = SkinBatch(config, 2, "sim://?sensor=paper&sensor_noise=1e-9&threshold=0", 0)
    good = np.full((2, 16), 20e3), np.zeros((2, 16))
    for which in range(2):
        bad = tuple(array.copy() for array in good)
        bad[which][1, 5] = wrong
        state = batch.begin(np.zeros(()))
        for arrays in [good, bad, *[good] * 40]:
            before = state.codes
            state, frame = batch.step(state, *arrays)
            if arrays is bad:
                assert np.flatnonzero(~frame.active).tolist() == [16 + 5]
                assert frame.codes[1, 5] == before[1, 5], "what it said last is held"
        assert np.abs(frame.pressure_pa / 20e3 - 1).max() < 0.02


def test_tared_skins_read_nothing_at_rest() -> None:
    options = "sim://?mismatch=0.05&threshold=0"
    idle = np.zeros((1, 16))
    for tared in (False, True):
        batch = SkinBatch(SkinConfig.of({}), 1, options, delay_frames=0, tared=tared)
        _, frame = batch.step(batch.begin(np.zeros(())), idle)
        assert (frame.pressure_pa == 0).all() == tared


def test_what_cannot_be_modelled_or_is_no_pressure_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = SkinConfig.of({"nodes": 16})
    with monkeypatch.context() as missing:
        missing.setitem(sys.modules, "array_api_compat", None)
        with pytest.raises(MissingPackageError, match="pip install array_api_compat"):
            SkinBatch(config, 1)
    for other in ("rows=2&columns=8", "pitch_mm=3", f"layout={LAYOUTS / 'sphere.yaml'}"):
        with pytest.raises(SpecError, match=r"driver's|nodes"):
            SkinBatch(config, 1, f"sim://?{other}")
    for option in OF_THE_LINE:
        with pytest.raises(SpecError, match=f"does not model {option}"):
            SkinBatch(config, 1, f"sim://?{option}")
    SkinBatch(config, 1, "sim://?scene=external&noise=0&speed=0")
    with pytest.raises(SpecError, match="nodes is 16, but 12 in the options"):
        SkinBatch(config, 1, "sim://?nodes=12")
    batch = SkinBatch(config, 2, "sim://?sensor_noise=0.01")
    with pytest.raises(ParameterError, match=r"call SkinBatch\.begin first"):
        batch.step(None, np.zeros((2, 16)))  # type: ignore[arg-type]
    state = batch.begin(np.zeros(()))
    with pytest.raises(ParameterError, match=r"must be \(2, 16\) of float64"):
        batch.step(state, array_api_strict.zeros((2, 16)))
    with pytest.raises(ParameterError, match=r"done .* must be \(2,\) of bool"):
        batch.reset(state, state, np.zeros(2))
    with pytest.raises(ParameterError, match="give `deviates`"):
        batch.step(state, np.zeros((2, 16)))


THINGS = [
    Sphere(radius_m=0.02, position_m=(0, 0, 0), stiffness_pa_per_m=2e7),
    Cylinder(radius_m=0.006, length_m=0.03, position_m=(0, 0, 0)),
    Box(size_m=(0.01, 0.02, 0.012), position_m=(0, 0, 0)),
    Ellipsoid(size_m=(0.01, 0.02, 0.014), position_m=(0, 0, 0)),
    Capsule(radius_m=0.006, length_m=0.02, position_m=(0, 0, 0)),
]


BOTH = pytest.mark.parametrize("asarray", [np.asarray, array_api_strict.asarray])
"""The kernel presses arrays of numpy; those of other libraries go through the array API."""


@BOTH
@pytest.mark.parametrize("layout", ["grid", "cylinder"])
@pytest.mark.parametrize("thing", THINGS, ids=lambda thing: type(thing).__name__)
def test_the_cover_is_that_of_single_objects(
    thing: Indenter, layout: str, asarray: Callable[..., Any]
) -> None:
    skin = Layout.grid(24, 4, 6, 5e-3, 4e-3)
    if layout == "cylinder":
        skin = SkinConfig.of(CYLINDER).layout
    rng = np.random.default_rng(2)
    taxels = rng.integers(len(skin), size=40)
    height_m = rng.uniform(-0.002, 0.018, (40, 1))
    places_m = skin.positions_m[taxels] + height_m * skin.normals[taxels]
    turned = rng.standard_normal((40, 4))
    turned[:8] = 0, 0, 0, 3
    turned[8:10] = 1, 0, 0, 1
    turned[10:14, :3] = 0  # about z
    felt_pa = np.asarray(BatchCover(skin).pressure_pa(thing, asarray(places_m), asarray(turned)))
    foundation = Foundation(skin.positions_m, skin.normals, skin.areas_m2, skin.aspect)
    for env, (place_m, quaternion) in enumerate(zip(places_m, turned, strict=True)):
        unit = quaternion / np.linalg.norm(quaternion)
        each = replace(thing, position_m=place_m.tolist(), orientation_xyzw=unit.tolist())
        np.testing.assert_allclose(felt_pa[env], foundation.pressure_pa([each]), atol=1e-3)
    assert (felt_pa.max(axis=1) > 0).mean() > 0.25
    if layout == "grid":
        upright = np.asarray(BatchCover(skin).pressure_pa(thing, asarray(places_m)))
        np.testing.assert_allclose(upright[:8], felt_pa[:8], atol=1e-6)


EVEN = Layout.grid(24, 4, 6, 5e-3, 3e-3)
LAYOUT = replace(EVEN, areas_m2=EVEN.areas_m2 * np.linspace(0.3, 1, 24, dtype=np.float32))


@BOTH
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("thing", THINGS, ids=lambda thing: type(thing).__name__)
def test_a_force_is_met_exactly_however_an_object_lies(
    thing: Indenter, asarray: Callable[..., Any]
) -> None:
    """Tilted, over an edge, beside the skin; by 0 and 10⁻⁴ to 100 N: only one depth has it.

    That is found by sorting, too, as for a single object.
    """
    rng, envs = np.random.default_rng(1), 4000 if asarray is np.asarray else 1000
    cover = BatchCover(LAYOUT)
    places_m, turned = rng.uniform(-0.04, 0.04, (envs, 3)), rng.standard_normal((envs, 4))
    force_n = 10 ** rng.uniform(-4, 2, envs)
    force_n[::100] = 0.0
    turned[:8] = 0, 0, 0, 3
    felt_pa = np.asarray(cover.pressure_pa(thing, *map(asarray, (places_m, turned, force_n))))
    upright_pa = cover.pressure_pa(thing, asarray(places_m[:8]), force_n=asarray(force_n[:8]))
    np.testing.assert_allclose(np.asarray(upright_pa), felt_pa[:8], rtol=1e-6, atol=1e-6)
    felt_n = felt_pa @ cover.areas_m2
    hit = felt_n > 0
    assert 0.1 * envs < np.count_nonzero(hit) < 0.95 * envs
    np.testing.assert_allclose(felt_n[hit], force_n[hit], rtol=1e-9)
    points_m = Foundation(LAYOUT.positions_m, LAYOUT.normals, LAYOUT.areas_m2).points_m
    areas_m2 = np.repeat(cover.areas_m2 / points_m.shape[1], points_m.shape[1])
    for env in [*np.flatnonzero(~hit)[:50], *np.flatnonzero(hit)[:150]]:
        there = thing.placed(Pose.of_quaternion(places_m[env], turned[env]))
        enters_m, _ = there.spans_m(points_m.reshape(-1, 3), LAYOUT.normals[:1])
        assert hit[env] == (force_n[env] > 0 and np.isfinite(enters_m).any())
        if hit[env]:
            met = np.isfinite(enters_m)
            stiffness_n_per_m = areas_m2 * thing.stiffness_pa_per_m
            shift_m = _step_m(enters_m[met], stiffness_n_per_m[met], force_n[env])
            depth_m = np.maximum(shift_m - enters_m, 0).reshape(24, -1).mean(axis=1)
            wanted_pa = thing.stiffness_pa_per_m * depth_m
            np.testing.assert_allclose(felt_pa[env], wanted_pa, rtol=1e-6, atol=1e-6)


def test_what_is_unknown_presses_with_nan_and_what_is_no_pose_is_refused() -> None:
    cover, ball = BatchCover(Layout.grid(16, 4, 4, 7e-3, 5e-3)), THINGS[0]
    places_m = np.zeros((3, 3))
    turned, force_n = np.tile([0.0, 0, 0, 1], (3, 1)), np.ones(3)
    for array, wrong in ((places_m, np.nan), (turned, np.nan), (force_n, np.nan), (force_n, -1.0)):
        array[1] = wrong
        felt_pa = cover.pressure_pa(ball, places_m, turned, force_n)
        assert np.isnan(felt_pa).all(axis=1).tolist() == [False, True, False]
        array[1] = array[0]
    for bad in ({"orientation_xyzw": places_m}, {"force_n": 2.0}):
        with pytest.raises(ParameterError, match=f"{next(iter(bad))} is .* it must be"):
            cover.pressure_pa(ball, **({"position_m": places_m} | bad))  # type: ignore[arg-type]
    bent = BatchCover(SkinConfig.of(CYLINDER).layout)
    with pytest.raises(ParameterError, match="flat skins"):
        bent.pressure_pa(ball, places_m, force_n=force_n)
    with pytest.raises(ParameterError, match="knows no str"):
        cover.pressure_pa("ball", places_m)  # type: ignore[arg-type]


def test_the_example_grips_what_it_does_not_know(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(LAYOUTS.parents[1] / "examples")
    example = import_module("batched_grip")
    rng = np.random.default_rng(5)
    worlds = example.Worlds.drawn(rng, 12)
    rules = np.array([0.013, 0.006, 8.5e-5], np.float32)[:, None]  # as it tunes them
    forces_n = example.gripped(rules, worlds, rng)
    assert np.median(np.abs(forces_n[-1] - example.FORCE_N)) < 0.05 * example.FORCE_N
    crushing = example.gripped(5 * rules, worlds, rng)
    assert example.cost(forces_n).mean() < 0.7 * example.cost(crushing).mean()
    monkeypatch.setattr(example, "GUESS", 3 * example.GUESS)
    assert (example.tuned(2, 8, 4) < example.GUESS).any(), "it learns to go more slowly"
