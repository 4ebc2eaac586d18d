# SPDX-License-Identifier: Apache-2.0

"""Scenes and sensing nodes: which taxels are pressed, and which nodes transmit when."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import DRIVES, SIMULATION, Value, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.readings.calibration import AdcScale
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.nodes import NodeFrame
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.scene import BEGUN_S, EVERY_S, PEAK_PA, REST_S, SCENES, SkinGeometry
from test.support.simulated import run, stream

SPEC = FrameSpec()
CONFIG = Path(__file__).resolve().parents[3] / "config"
SECONDS = np.arange(0, 20, 0.05)


def skin(nodes: int = 16, seed: int = 1) -> SkinGeometry:
    return SimOptions(seed=seed).skin(nodes)


def pressures(scene: str, nodes: int = 16) -> np.ndarray:
    taxels = skin(nodes)
    return np.array([SCENES[scene](t, taxels) for t in SECONDS])


@pytest.mark.parametrize("nodes", [1, 16, 17, 1024])
@pytest.mark.parametrize("scene", SCENES)
def test_pressures_are_finite_and_plausible(scene: str, nodes: int) -> None:
    field = pressures(scene, nodes)
    assert field.shape == (len(SECONDS), nodes)
    assert np.all((field >= 0) & (field <= PEAK_PA))
    if scene != "idle":
        assert field.max() > 50e3  # both stages of the sensor are seen


def test_scenes_are_what_they_are_called() -> None:
    assert not pressures("idle").any()
    assert np.count_nonzero(pressures("press").max(axis=0)) == 1
    press = pressures("press").max(axis=1)
    assert 0.3 < np.mean(press == 0) < 0.7
    assert np.count_nonzero(pressures("presses").max(axis=0)) >= 3
    moving = pressures("moving")
    assert np.all(moving.max(axis=0) > 0), "the contact visits every taxel"
    assert np.all(np.count_nonzero(moving, axis=1) < 16)
    at_rest = (SECONDS + BEGUN_S) % EVERY_S < REST_S
    demo = pressures("demo")
    assert not demo[at_rest].any() and demo[~at_rest].any(axis=1).all(), "time for a tare"
    assert at_rest[SECONDS < 3].all()
    assert SimOptions().scene == "demo"
    assert pressures("all").min() > 10e3
    assert np.mean(pressures("hand") > 0) > 0.8, "a small skin is covered"
    assert 0.02 < np.mean(pressures("hand", 4096) > 0) < 0.3, "a large one is not"


def frames_of(pulses: dict[int, float], count: int, **options: int) -> list[NodeFrame]:
    """Frames in which node 0 feels some pressure (Pa) during some frames."""

    def scene(t_s: float, taxels: SkinGeometry) -> np.ndarray:
        field = np.zeros(len(taxels.positions_m))
        field[0] = pulses.get(round(t_s / SPEC.frame_period_s), 0.0)
        return field

    return list(islice(truth(SimOptions(**options), Setup(SPEC), scene=scene), count))


def test_a_node_talks_while_pressed_and_once_after_release() -> None:
    frames = frames_of({3: 20e3, 4: 20e3}, 8, heartbeat=0)
    assert [bool(f.active[0]) for f in frames] == [False] * 3 + [True] * 3 + [False] * 2
    assert frames[5].codes[0] == 1023, "the release is told"
    assert not any(f.active[1:].any() for f in frames)


def test_changes_within_the_threshold_are_not_told() -> None:
    one_lsb_pa = 1.6 * AdcScale(10).lsb_v / 0.033e-3
    for threshold, told in ((1, False), (0, True)):
        frames = frames_of({2: one_lsb_pa}, 3, threshold=threshold, heartbeat=0)
        assert frames[2].codes[0] < 1023
        assert frames[2].active[0] == told


@pytest.mark.parametrize("heartbeat", [1, 5, 16, 78])
def test_heartbeats_take_turns(heartbeat: int) -> None:
    frames = frames_of({}, 3 * heartbeat, heartbeat=heartbeat)
    talked = np.array([f.active for f in frames])
    first = talked[:heartbeat]
    assert np.all(first.sum(axis=0) == 1), "everyone once within the first period"
    assert first.sum(axis=1).max() == -(-16 // heartbeat), "spread evenly"
    assert np.array_equal(talked, np.tile(first, (3, 1)))


def shipped_skins() -> Iterator[tuple[str, dict[str, Value]]]:
    """What every skin in the parameter and body files of config/ is called and set to."""
    for path in sorted(CONFIG.glob("*.yaml")):
        if "ros__parameters" in path.read_text():
            yield path.stem, read_file(path)
        else:
            for patch in read_body(path).patches:
                file = read_file(patch.params_file) if patch.params_file else {}
                yield f"{path.stem}: {patch.name}", {**file, **patch.parameters}


SHIPPED = dict(shipped_skins())


def stale_after_all_spoke(config: SkinConfig, url: str, frames: int) -> float:
    """Share of the taxels that are stale once each node had a second or a frame to speak."""
    status = np.array([frame.readings.status for frame in run(config, stream(config, url, frames))])
    begun = status[int(1.5 / config.spec.frame_period_s) + 1 :]
    return float(np.mean((begun & Status.STALE) != 0))


def test_config_has_parameter_files_and_bodies() -> None:
    assert {"skin", "wired_skin", "wired_64", "body: chest", "body: right_elbow"} <= set(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_no_shipped_skin_goes_stale_untouched(name: str) -> None:
    values = {**SHIPPED[name], "sync": DRIVES}  # here it is alone
    config, port = SkinConfig.of(values), str(values.get("port", ""))
    kept = port.partition("?")[2].split("&") if port.startswith(SIMULATION) else []
    options = [option for option in kept if option and not option.startswith("scene=")]
    options += ["scene=idle", f"amplitude_mv={config.spec.amplitude_v * 1e3}"]
    options += [f"sync_wire={config.sync_wire}"]
    frames = int((config.stale_after_s + 1.5) / config.spec.frame_period_s)
    assert stale_after_all_spoke(config, f"sim://?{'&'.join(options)}", frames) == 0
    if name == "skin":  # else there were nothing to see
        deaf = f"sim://?{'&'.join([*options, 'heartbeat=0'])}"
        assert stale_after_all_spoke(config, deaf, frames) > 0.9


@settings(max_examples=8)
@given(st.floats(10.5, 3000.0), st.integers(1, 16), st.floats(1.02, 1.5))
def test_an_untouched_skin_is_not_stale_at_any_period(
    period_ms: float, nodes: int, margin: float
) -> None:
    """Where stale_after_s exceeds a second and a half, and the frame period."""
    period_s = round(period_ms, 3) * 1e-3
    limit_s = margin * max(1.5, period_s)
    values = {"nodes": nodes, "frame_period_ms": period_s * 1e3, "stale_after_s": limit_s}
    config = SkinConfig.of(values)
    frames = int(3 * limit_s / period_s) + 3
    url = f"sim://?scene=idle&samples_per_chip=3&seed={nodes}"
    assert stale_after_all_spoke(config, url, frames) == 0
