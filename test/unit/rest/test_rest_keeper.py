# SPDX-License-Identifier: Apache-2.0

"""Tare, drift and calibration across restarts of one skin, in simulated time, and their file."""

import os
import stat
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile_cdma.base import whole_file
from tactile_cdma.base.errors import RestError
from tactile_cdma.config.parameters import PARAMETERS
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.status import Status
from tactile_cdma.rest import rest_file, rest_keeper
from tactile_cdma.rest.rest_file import (
    RestState,
    RestStore,
    calibration_path,
    read_rest,
    rest_path,
    write_rest,
)
from tactile_cdma.rest.rest_keeper import RestKeeper
from tactile_cdma.sim.scene import SCENES, SkinGeometry
from test.support.calibrations import write_calibration
from test.support.simulated import started

IDLE = "sim://?scene=idle"
NAME = "skin.rest.yaml"
COUNT_V, COUNT_PA = 3.3 / 1024, 97.66
PRELOAD_PA = 8 * COUNT_PA
REST_V = 3.3 - 8 * COUNT_V
TARE_S = 1.5
"""Longer than a tare takes: the last second, from the first frame on."""
Preload = Callable[[float], None]
OTHER_CURVE = PressureCurve.two_stage(knee_pa=40e3)


class Log:
    def __init__(self) -> None:
        self.infos: list[str] = []
        self.warnings: list[str] = []
        self.info, self.warning = self.infos.append, self.warnings.append


class Run:
    """One skin from its configuration on; `stream` feeds what a digitizer sends meanwhile."""

    def __init__(self, folder: Path, port: str = IDLE, **values: object) -> None:
        self.values, self.port = values, port
        self.config = SkinConfig.of(values)
        self.log, self.changes = Log(), 0
        self.keeper = RestKeeper(self.config, port, folder / NAME, self.log, self._changed)
        self.frames: list[TactileFrame] = []

    def _changed(self) -> None:
        self.changes += 1

    def activate(self) -> "Run":
        config = self.keeper.config
        self.driver = Driver(config, self.port, 2_000_000, lambda _: None, lambda _: None)
        self.keeper.activate(self.driver)
        self.digitizer = started(config, IDLE)
        self._end_s = self._t_host = 0.0
        return self

    def tared(self) -> "Run":
        self.activate().stream(TARE_S).keeper.tare()
        return self

    def stream(self, seconds: float) -> "Run":
        self._end_s += seconds
        self.frames = []
        while not self.frames or self.frames[-1].t_middle < self._end_s:
            self.digitizer.advance(4096)
            self._t_host += 1e-3
            self.frames += self.driver.pipeline.feed(self.digitizer.take(4096), self._t_host)
        return self

    def set(self, **values: object) -> None:
        """Change parameters as the driver's node does it."""
        self.values |= values
        everything = {parameter.name: parameter.default for parameter in PARAMETERS} | self.values
        config = self.keeper.config.adjusted(everything)
        if "calibration_file" in values:
            config = config.recalibrated(everything)
        self.keeper.adjust(config)

    @property
    def pressure_pa(self) -> np.ndarray:
        return self.frames[-1].readings.pressure_pa

    @property
    def drift_v(self) -> np.ndarray:
        assert self.keeper.baseline is not None
        return self.keeper.baseline.drift_v


@pytest.fixture(autouse=True)
def preload(monkeypatch: pytest.MonkeyPatch) -> Preload:
    """The idle skin is mounted under PRELOAD_PA, or another pressure by a call, also meanwhile."""
    load_pa = [PRELOAD_PA]

    def scene(t_s: float, skin: SkinGeometry) -> np.ndarray:
        return np.full(len(skin.positions_m), load_pa[0])

    monkeypatch.setitem(SCENES, "idle", scene)
    return lambda pressure_pa: load_pa.__setitem__(0, pressure_pa)


def on_file(folder: Path) -> dict[str, object]:
    content: dict[str, object] = yaml.safe_load((folder / NAME).read_text())
    return content


def test_a_tare_outlives_the_run(tmp_path: Path) -> None:
    first = Run(tmp_path).activate().stream(TARE_S)
    assert np.allclose(first.pressure_pa, PRELOAD_PA, atol=15)
    assert first.keeper.tare() == "tared: 0.78 to 0.78 kPa are taken off"
    assert first.keeper.baseline is not None
    assert np.allclose(first.keeper.baseline.tare_pa, PRELOAD_PA, atol=15)
    assert first.changes == 2
    assert np.allclose(first.stream(0.1).pressure_pa, 0, atol=15)
    assert np.allclose(on_file(tmp_path)["rest_v"], REST_V)
    first.keeper.deactivate()
    again = Run(tmp_path)
    assert again.keeper.tared == first.keeper.tared == on_file(tmp_path)["tared"]
    for run in (first, again, again):
        run.activate().stream(0.3)
        assert np.allclose(run.pressure_pa, 0, atol=15)
        told = run.log.warnings.pop()
        assert "tare and drift are those of" in told and "found on a simulated skin" in told
        run.keeper.deactivate()
    assert not again.log.warnings


def test_a_tare_of_one_scene_is_not_that_of_another(preload: Preload, tmp_path: Path) -> None:
    preload(52e3)
    Run(tmp_path).activate().stream(TARE_S).keeper.tare(force=True)
    other = Run(tmp_path, "sim://?scene=hand").activate().stream(0.3)
    assert np.allclose(other.pressure_pa, 52e3, atol=300) and not other.log.warnings
    assert other.keeper.tared == "" and "it is of sim://?scene=idle" in other.log.infos[-1]
    other.stream(TARE_S).keeper.tare(force=True)
    assert np.allclose(Run(tmp_path).activate().stream(0.3).pressure_pa, 52e3, atol=300)
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


@pytest.mark.parametrize("earlier", [False, True])
def test_a_tare_that_is_dropped_while_it_is_written_is_nobodys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, earlier: bool
) -> None:
    """The digitizer says what it is, in the driver's thread, before or after the file is made."""
    run = Run(tmp_path, port="/dev/ttyACM0").activate().stream(TARE_S)
    write = rest_file.write_rest

    def slow(path: Path, state: RestState) -> None:
        if earlier:
            run.keeper.hear(simulated=True)
        write(path, state)
        if not earlier:
            run.keeper.hear(simulated=True)

    monkeypatch.setattr(rest_file, "write_rest", slow)
    run.keeper.tare()
    monkeypatch.setattr(rest_file, "write_rest", write)
    assert np.allclose(run.stream(TARE_S).pressure_pa, PRELOAD_PA, atol=15)
    assert run.keeper.tared == ""
    run.keeper.tare()
    assert on_file(tmp_path)["simulated"] == "yes"
    assert yaml.safe_load((tmp_path / f"{NAME}.old").read_text())["simulated"] == "no"


def test_a_third_skins_tare_costs_nobody_his(tmp_path: Path) -> None:
    for skin in ("left", "right", "spare"):
        Run(tmp_path, skin=skin).tared()
    kept = [yaml.safe_load(path.read_text())["skin"] for path in sorted(tmp_path.iterdir())]
    assert kept == ["spare", "left", "right"]


def test_a_simulators_tare_is_dropped_once_a_board_introduces_itself(tmp_path: Path) -> None:
    Run(tmp_path).tared()
    run = Run(tmp_path, port="/dev/ttyACM0").activate()
    assert "found on a simulated skin" in run.log.warnings.pop()
    run.keeper.hear(simulated=True)  # an emulator behind a tty: it stays
    assert np.allclose(run.stream(0.3).pressure_pa, 0, atol=15) and not run.log.warnings
    run.keeper.hear(simulated=False)
    assert "it is of a simulated skin, this is a real one" in run.log.warnings.pop()
    assert run.keeper.tared == ""
    assert np.allclose(run.stream(TARE_S).pressure_pa, PRELOAD_PA, atol=15)
    run.keeper.tare()
    assert on_file(tmp_path)["simulated"] == "no"
    assert (tmp_path / f"{NAME}.old").exists()


def test_no_frame_has_a_tare_that_is_dropped(tmp_path: Path) -> None:
    Run(tmp_path).tared()
    run = Run(tmp_path, port="/dev/ttyACM0").activate()
    run.driver.pipeline.on_info = lambda info: run.keeper.hear(simulated=False)
    read_pa = [frame.readings.pressure_pa for frame in run.stream(0.3).frames]
    assert np.allclose(read_pa, PRELOAD_PA, atol=15)


def test_a_boards_tare_is_not_that_of_a_simulator_behind_a_tty(tmp_path: Path) -> None:
    board = Run(tmp_path, port="/dev/ttyACM0").activate().stream(TARE_S)
    board.keeper.hear(simulated=False)
    board.keeper.tare()
    run = Run(tmp_path, port="socket://localhost:9").activate()
    assert not run.log.warnings
    run.keeper.hear(simulated=True)
    assert "it is of a real skin, this is a simulated one" in run.log.warnings.pop()
    assert np.allclose(run.stream(0.3).pressure_pa, PRELOAD_PA, atol=15)


def test_a_tare_under_load_is_forced_and_cleared(preload: Preload, tmp_path: Path) -> None:
    preload(20e3)
    run = Run(tmp_path).activate().stream(TARE_S)
    with pytest.raises(RestError, match=r"under load: node 1 \(row 0, column 0\)"):
        run.keeper.tare()
    assert list(tmp_path.iterdir()) == []
    assert run.keeper.tared == "" and run.changes == 1
    run.keeper.tare(force=True)
    assert np.allclose(run.stream(0.1).pressure_pa, 0, atol=15)
    assert run.keeper.tared == on_file(tmp_path)["tared"] != ""
    run.keeper.clear()
    assert np.allclose(run.stream(0.1).pressure_pa, 20e3, atol=100)
    assert run.keeper.tared == on_file(tmp_path)["tared"] == ""
    assert on_file(tmp_path)["rest_v"] is None
    assert run.changes == 3


def restarted(run: Run, folder: Path) -> Run:
    run.keeper.deactivate()
    return Run(folder, **run.values).activate()


def activated_again(run: Run, folder: Path) -> Run:
    run.keeper.deactivate()
    return run.activate()


def recalibrated(run: Run, folder: Path) -> Run:
    """And back, so that a load is the same pressure before and after."""
    path = folder / "other.yaml"
    write_calibration(path, Calibration.default(OTHER_CURVE, 16), AdcScale())
    run.set(calibration_file=str(path))
    run.set(calibration_file="")
    return run


@pytest.mark.parametrize("again", [restarted, activated_again, recalibrated])
def test_tares_under_a_growing_load_hide_no_more_than_two_contacts_whatever_is_in_between(
    preload: Preload, tmp_path: Path, again: Callable[[Run, Path], Run]
) -> None:
    """Each load is less than a contact more than the one before."""
    preload(0.0)
    run, refused = Run(tmp_path).activate().stream(3.0), ""
    run.keeper.tare()
    for load_pa in np.arange(900.0, 7300.0, 900.0):
        run = again(run, tmp_path)
        preload(load_pa)
        run.stream(TARE_S)
        try:
            run.keeper.tare()
        except RestError as error:
            refused = str(error)
    assert "not tared, under load" in refused
    assert (run.pressure_pa > 7200 - 2 * 1000).all(), "a load was taken for rest"
    preload(0.0)
    run.stream(TARE_S).keeper.tare()
    assert np.allclose(run.stream(0.1).pressure_pa, 0, atol=15)


def test_a_forced_tare_is_what_is_rest_after_a_restart(preload: Preload, tmp_path: Path) -> None:
    preload(5000.0)
    run = Run(tmp_path).activate().stream(TARE_S)
    run.keeper.tare(force=True)
    run = restarted(run, tmp_path)
    preload(5900.0)
    run.stream(TARE_S).keeper.tare()
    run = restarted(run, tmp_path)
    preload(6800.0)
    with pytest.raises(RestError, match="under load"):
        run.stream(TARE_S).keeper.tare()


def test_a_file_without_a_lowest_zero_has_the_present(preload: Preload, tmp_path: Path) -> None:
    preload(900.0)
    run = Run(tmp_path).tared()
    run.keeper.deactivate()
    content = on_file(tmp_path)
    del content["least_v"]
    (tmp_path / NAME).write_text(yaml.safe_dump(content))
    run = Run(tmp_path).activate()
    preload(1800.0)
    run.stream(TARE_S).keeper.tare()
    assert np.allclose(run.stream(0.1).pressure_pa, 0, atol=15)


def test_a_tare_names_the_nodes_that_keep_what_they_had(tmp_path: Path) -> None:
    run = Run(tmp_path, stale_after_s=0.5).activate().stream(TARE_S)
    run.driver.pipeline.taxels.chain.baseline.look(
        np.zeros(16, np.float32), np.zeros(16, np.float32), np.arange(16) != 6
    )
    assert run.keeper.tare(force=True).endswith("; as before, without a certain reading: node 7")


def test_without_frames_there_is_no_tare(tmp_path: Path) -> None:
    run = Run(tmp_path)
    for tare in (run.keeper.tare, run.keeper.clear):
        with pytest.raises(RestError, match="not tared: the skin is not active"):
            tare()
    run.activate()
    with pytest.raises(RestError, match=r"not tared: .* less than 1 s"):
        run.keeper.tare()
    run.stream(TARE_S)
    run.driver.problem = "the port is gone"
    for tare in (run.keeper.tare, run.keeper.clear):
        with pytest.raises(RestError, match="not tared: no frames arrive: the port is gone"):
            tare()
    run.keeper.deactivate()
    with pytest.raises(RestError, match="not tared: the skin is not active"):
        run.keeper.tare()


@pytest.mark.parametrize("content", ["nonsense: [", "other nodes"])
def test_a_file_that_does_not_fit_is_set_aside_for_another(tmp_path: Path, content: str) -> None:
    path = tmp_path / NAME
    if content == "other nodes":
        Run(tmp_path, nodes=9, rows=3, columns=3).keeper.save()
        content = path.read_text()
    path.write_text(content)
    run = Run(tmp_path).activate().stream(TARE_S)
    assert len(run.log.warnings) == 1
    assert np.allclose(run.pressure_pa, PRELOAD_PA, atol=15)
    run.keeper.deactivate()
    assert path.read_text() == content
    run.activate().stream(TARE_S).keeper.tare()
    assert path.with_name(f"{NAME}.old").read_text() == content
    assert on_file(tmp_path)["nodes"] == 16


def test_a_calibration_that_was_put_there_is_not_overwritten(tmp_path: Path) -> None:
    """The one in force stays as it is, with its comments; another one is set aside."""
    kept, lab = tmp_path / "skin.calibration.yaml", "# the lab's, of May\n"
    other = Calibration.default(OTHER_CURVE, 16)
    for calibration in (Calibration.default(PressureCurve.two_stage(), 16), other):
        write_calibration(kept, calibration, AdcScale())
        kept.write_text(lab + kept.read_text())
        assert Run(tmp_path).keeper.save() == (tmp_path / NAME, kept)
        assert kept.read_text().startswith(lab) == (calibration is not other)
    assert (tmp_path / "skin.calibration.yaml.old").read_text().startswith(lab)


def test_a_calibration_tried_while_inactive_costs_no_tare(tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    write_calibration(other, Calibration.default(OTHER_CURVE, 16), AdcScale())
    run = Run(tmp_path).tared()
    run.keeper.deactivate()
    run.set(calibration_file=str(other))
    assert "other curves" in run.log.warnings[-1] and run.keeper.tared == ""
    run.set(calibration_file="")
    assert np.allclose(run.activate().stream(0.3).pressure_pa, 0, atol=15)


def test_a_calibration_with_the_same_curves_keeps_the_tare(tmp_path: Path) -> None:
    run = Run(tmp_path).tared()
    _, calibration = run.keeper.save()
    for _ in range(2):
        run.set(calibration_file=str(calibration))
    run.keeper.tick()
    assert sum("is in use" in line for line in run.log.infos) == 1
    assert run.changes == 4 and run.log.infos[-1].endswith("tare and drift stay, by its curves")
    assert np.allclose(run.stream(0.1).pressure_pa, 0, atol=15)
    run.set(active_share=0.6)
    assert run.changes == 4


def test_other_curves_keep_the_rest_that_a_tare_was_taken_at(tmp_path: Path) -> None:
    steep = PressureCurve.two_stage(stage1_v_per_pa=0.066e-3, knee_pa=24e3)
    write_calibration(tmp_path / "steep.yaml", Calibration.default(steep, 16), AdcScale())
    run = Run(tmp_path).tared()
    run.set(calibration_file=str(tmp_path / "steep.yaml"))
    assert run.keeper.tared and run.changes == 3
    assert np.allclose(run.stream(0.3).pressure_pa, 0, atol=15)
    baseline = run.keeper.baseline
    assert baseline is not None and np.allclose(baseline.tare_pa, PRELOAD_PA / 2, atol=15)
    run.keeper.deactivate()  # and the file goes with the curves in force
    run = Run(tmp_path, calibration_file=str(tmp_path / "steep.yaml"))
    assert np.allclose(run.activate().stream(0.3).pressure_pa, 0, atol=15)


def test_without_a_folder_to_write_to_the_skin_goes_on(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    run = Run(tmp_path / "file").tared()
    run.keeper.tare()
    assert len(run.log.warnings) == 1 and "not kept" in run.log.warnings[0]
    with pytest.raises(RestError, match="not kept"):
        run.keeper.save()
    run.keeper.deactivate()
    assert np.allclose(run.activate().stream(0.3).pressure_pa, 0, atol=15)


def test_what_was_found_on_a_simulator_and_not_saved_is_dropped_on_a_board(tmp_path: Path) -> None:
    """A tare that could not be written, and drift that was not yet due."""
    (tmp_path / "no").write_text("a file, not a folder")
    run = Run(tmp_path / "no", port="socket://localhost:1").activate().stream(TARE_S)
    run.keeper.hear(simulated=True)
    run.keeper.tare()
    assert not run.stream(0.3).pressure_pa.any()
    run.keeper.hear(simulated=False)
    assert np.allclose(run.stream(0.3).pressure_pa, PRELOAD_PA, atol=COUNT_PA / 2)
    assert run.keeper.tared == ""
    assert "tare and drift are dropped" in run.log.warnings[-1]
    run.keeper.hear(simulated=True)
    run.driver.pipeline.taxels.restore(None, np.full(16, 0.03, np.float32))
    run.keeper.hear(simulated=False)
    assert not run.drift_v.any()


def test_of_a_replayed_recording_nothing_is_read_or_kept(tmp_path: Path) -> None:
    Run(tmp_path).tared()
    before = (tmp_path / NAME).read_text()
    run = Run(tmp_path, "replay://skin.rec").activate().stream(TARE_S)
    assert np.allclose(run.pressure_pa, PRELOAD_PA, atol=15)
    run.keeper.tare()
    assert np.allclose(run.stream(0.1).pressure_pa, 0, atol=15)
    with pytest.raises(RestError, match="of a recording that is replayed are not kept"):
        run.keeper.save()
    run.keeper.deactivate()
    assert run.keeper.tared == ""
    assert np.allclose(run.activate().stream(0.3).pressure_pa, PRELOAD_PA, atol=15)
    assert (tmp_path / NAME).read_text() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_drift_is_kept(preload: Preload, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The skin rests a count off where it was tared, then two."""
    monkeypatch.setattr(rest_keeper, "TELL_S", 0.0)
    monkeypatch.setattr(rest_keeper, "SAVE_S", 0.0)
    monkeypatch.setattr("tactile_cdma.readings.drift.SETTLE_S", 1.0)
    run = Run(tmp_path, drift_pa_per_min=0.0).tared()
    for counts in (1, 2):
        run.set(drift_pa_per_min=0.0)
        preload(PRELOAD_PA + 1.2 * counts * COUNT_PA)
        assert np.allclose(run.stream(0.5).pressure_pa, COUNT_PA, atol=1)
        changes = run.changes
        run.keeper.tick()
        assert run.changes == changes
        run.set(drift_pa_per_min=1e4)
        assert np.allclose(run.stream(4).pressure_pa, 0, atol=2)
        run.keeper.tick()
        assert run.changes == changes + 1
        assert np.allclose(run.drift_v, counts * COUNT_V, rtol=0.02)
        assert np.allclose(on_file(tmp_path)["drift_v"], counts * COUNT_V, rtol=0.02)
    run.keeper.tick()
    assert run.changes == changes + 1  # nothing has changed
    again = Run(tmp_path, drift_pa_per_min=1e4).activate().stream(0.3)
    assert np.allclose(again.pressure_pa, 0, atol=3)
    assert np.allclose(again.drift_v, 2 * COUNT_V, rtol=0.02)


def test_drift_is_told_and_saved_seldom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [1000.0]
    monkeypatch.setattr(rest_keeper.time, "monotonic", lambda: now_s[0])
    run = Run(tmp_path).tared()
    assert run.keeper.baseline is not None
    for after_s, count in ((9.9, 2), (10.1, 3), (19.9, 3), (59.9, 4)):
        now_s[0] = 1000.0 + after_s
        run.keeper.baseline.drift_v = run.drift_v + np.float32(COUNT_V)
        run.keeper.tick()
        assert run.changes == count
        assert on_file(tmp_path)["drift_v"] is None
    now_s[0] += 0.2
    run.keeper.tick()
    assert np.allclose(on_file(tmp_path)["drift_v"], 4 * COUNT_V, rtol=0.02)
    run.keeper.baseline.drift_v = run.drift_v + np.float32(COUNT_V)
    run.keeper.deactivate()
    assert np.allclose(on_file(tmp_path)["drift_v"], 5 * COUNT_V, rtol=0.02)


def test_masks_of_parameter_and_service_add_up_and_are_undone_apart(tmp_path: Path) -> None:
    run = Run(tmp_path, masked="3").activate().stream(1.2)

    def masked() -> list[int]:
        run.stream(0.1)
        is_nan = np.isnan(run.pressure_pa)
        assert np.array_equal(is_nan, run.frames[-1].readings.status & Status.MASKED != 0)
        return (np.flatnonzero(is_nan) + 1).tolist()

    assert masked() == [3]
    assert "nodes 3, 5, 9" in run.keeper.mask([9, 5])
    told = run.changes
    assert masked() == [3, 5, 9]
    run.set(masked="3, 4")
    assert masked() == [3, 4, 5, 9] and run.changes == told + 1
    with pytest.raises(RestError, match="still masked: node 3: the layout, or the parameter"):
        run.keeper.mask([3, 5], back=True)
    for wrong in ([0], [17]):
        with pytest.raises(RestError, match=f"the skin has 16 nodes, and no node {wrong[0]}"):
            run.keeper.mask(wrong)
    with pytest.raises(RestError, match="name them"):
        run.keeper.mask([])
    run.keeper.mask([5], back=True)
    run.set(masked="")
    assert masked() == [9]
    run.keeper.deactivate()
    again = Run(tmp_path).activate().stream(1.2)
    assert np.isnan(again.pressure_pa[8]) and again.keeper.masked == (9,)
    assert "masked by ~/mask: node 9" in again.log.infos
    again.keeper.mask([], back=True)
    state = read_rest(tmp_path / NAME)
    assert state is not None and state.masked == ()
    assert np.isfinite(again.stream(0.1).pressure_pa).all()


def test_a_mask_outlasts_other_curves_as_no_tare_does_but_is_of_one_skin(tmp_path: Path) -> None:
    run = Run(tmp_path).tared()
    run.keeper.mask([2])
    run.keeper.deactivate()
    path = tmp_path / "other.yaml"
    write_calibration(path, Calibration.default(OTHER_CURVE, 16), AdcScale())
    other = Run(tmp_path, calibration_file=str(path))
    assert other.keeper.masked == (2,) and other.keeper.tared == ""
    assert any("not used" in text for text in other.log.warnings)
    other.activate().stream(1.2)
    assert np.flatnonzero(np.isnan(other.pressure_pa)).tolist() == [1]
    assert other.keeper.baseline is not None and not other.keeper.baseline.tared
    other.keeper.hear(simulated=False)  # it was found on a simulated skin
    assert other.keeper.masked == ()
    assert np.isfinite(other.stream(0.1).pressure_pa).all()


STATE = RestState(
    skin="left palm",
    simulated=True,
    scene="sim://?scene=idle",
    nodes=3,
    calibration="0123456789ab",
    curves="89abcdef",
    written="2026-11-21T16:00:00+01:00",
    tared="2026-11-21T15:00:00+01:00",
    rest_v=np.array([3.0, 2.9, 1.5], np.float32),
    drift_v=np.array([1e-3, -2e-6, 0.0], np.float32),
)


def values(limit: float) -> st.SearchStrategy[np.ndarray | None]:
    return st.none() | arrays(np.float32, 3, elements=st.floats(-limit, limit, width=32))


@given(st.tuples(*[values(8.0)] * 4))
def test_what_is_written_is_read_to_far_below_a_count(
    tmp_path_factory: pytest.TempPathFactory, kept: tuple[np.ndarray | None, ...]
) -> None:
    path = tmp_path_factory.mktemp("rest") / "skin.rest.yaml"
    names = ("rest_v", "drift_v", "tared_drift_v", "least_v")
    state = replace(STATE, **dict(zip(names, kept, strict=True)))
    write_rest(path, state)
    back = read_rest(path)
    assert back is not None
    for name in (field.name for field in fields(RestState)):
        ours, theirs = getattr(state, name), getattr(back, name)
        if isinstance(ours, np.ndarray):
            assert theirs.dtype == np.float32
            assert np.allclose(ours, theirs, rtol=1e-6, atol=1e-8)
        else:
            assert ours == theirs, name


def test_files_are_named_after_their_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "ros"))
    assert rest_path("", "/skin") == tmp_path / "ros" / "tactile_cdma" / "skin.rest.yaml"
    monkeypatch.delenv("ROS_HOME")
    below_home = tmp_path / "home" / ".ros" / "tactile_cdma"
    assert rest_path("", "/left/hand/skin") == below_home / "left.hand.skin.rest.yaml"
    assert rest_path("~/skins", "/skin") == tmp_path / "home" / "skins" / "skin.rest.yaml"
    simulated = rest_path("~/skins", "/skin", simulated=True)
    assert simulated == tmp_path / "home" / "skins" / "skin-simulated.rest.yaml"


def test_no_two_nodes_share_a_file() -> None:
    nodes = ("/skin", "/a/rest/skin", "/a/calibration/skin", "/rest", "/calibration")
    rests = [rest_path("/state", node, kind) for node in nodes for kind in (False, True)]
    assert calibration_path(rests[0]) == Path("/state/skin.calibration.yaml")
    assert len({*rests, *map(calibration_path, rests)}) == 4 * len(nodes)


def test_a_home_that_nobody_has_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RestError, match=r"-name/skins: tare .* the user after ~ has no home"):
        rest_path("~nobody-of-that-name/skins", "/skin")
    monkeypatch.setenv("ROS_HOME", "~nobody-of-that-name")
    with pytest.raises(RestError, match="~nobody-of-that-name/tactile_cdma"):
        rest_path("", "/skin")


def test_writing_replaces_the_file_as_a_whole_or_names_the_cause(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "folder" / "skin.rest.yaml"
    write_rest(path, STATE)
    write_rest(path, replace(STATE, rest_v=None))
    back = read_rest(path)
    assert back is not None and back.rest_v is None
    assert os.listdir(path.parent) == [path.name]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RestError, match=r"file/skin\.yaml: tare and drift are not kept: "):
        write_rest(tmp_path / "file" / "skin.yaml", STATE)
    if getattr(os, "geteuid", int)() != 0:
        tmp_path.chmod(stat.S_IREAD | stat.S_IEXEC)
        with pytest.raises(RestError, match="not kept: Permission denied"):
            write_rest(tmp_path / "skin.yaml", STATE)


def test_files_set_aside_stay_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And at no moment there is none: a kill before the next write loses nothing."""
    path = tmp_path / "skin.rest.yaml"
    assert whole_file.keep_aside(path) is None
    monkeypatch.setattr(whole_file, "MOST_ASIDE", 12)
    for number in range(1, 13):
        write_rest(path, replace(STATE, skin=f"skin {number}"))
        aside = whole_file.keep_aside(path)
        assert aside == tmp_path / f"skin.rest.yaml.old{number if number > 1 else ''}"
        for kept in (aside, path, tmp_path / "skin.rest.yaml.old"):
            state = read_rest(kept)
            assert state is not None and state.skin in (f"skin {number}", "skin 1")
    store = RestStore(path, Log())
    store.disown()
    with pytest.raises(RestError, match=r"be set aside: remove some of skin\.rest\.yaml\.old"):
        store.write(STATE)


def test_a_link_is_replaced_not_its_target(tmp_path: Path) -> None:
    target, path = tmp_path / "mine.yaml", tmp_path / "skin.rest.yaml"
    target.write_text("precious")
    path.symlink_to(target)
    write_rest(path, STATE)
    assert target.read_text() == "precious" and read_rest(path) is not None


GOOD = {
    "schema": "tactile_cdma/rest",
    "version": 1,
    "written": "",
    "skin": "",
    "simulated": "no",
    "nodes": 2,
    "calibration": "",
    "curves": "",
    "tared": "",
    "rest_v": [3, 2.9],
    "drift_v": None,
}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({"schema": "something/else"}, "it must be 'tactile_cdma/rest'"),
        ({"version": 2}, "version is 2; this program reads version 1"),
        ({"nodes": "x"}, "line 4: nodes is 'x'; it must be a whole number"),
        ({"skin": [5]}, "skin is a list; it must be text"),
        ({"rest_v": [1.0]}, "rest_v has 1 entries; it must have 2"),
        ({"rest_v": "12"}, "rest_v is '12'; it must be a list"),
        ({"rest_v": [1.0, "x"]}, "number 2 of rest_v is 'x'"),
        ({"rest_v": [True, 1.0]}, "number 1 of rest_v is 'true'"),
        ({"rest_v": [1.0, float("nan")]}, "number 2 of rest_v is .nan"),
        ({"drift_v": [0.0, 101.0]}, "number 2 of drift_v is 101; it must lie within -100…100 V"),
        ("", "empty"),
        ("- a\n- b", "must be keys with values"),
        ("a: b", "schema"),
        ("a: [1, 2", "not a YAML file"),
        ("!!python/object/apply:os.system ['true']", "must be keys with values"),
    ],
)
def test_what_is_no_such_file_is_refused_with_its_name_and_the_cause(
    tmp_path: Path, content: dict[str, object] | str, reason: str
) -> None:
    """Damaged values, and files of any other kind; test_program has what else is no plain YAML."""
    path = tmp_path / NAME
    path.write_text(yaml.safe_dump(GOOD))
    assert read_rest(path) is not None
    text = content if isinstance(content, str) else yaml.safe_dump({**GOOD, **content})
    path.write_text(text)
    with pytest.raises(RestError) as refused:
        read_rest(path)
    assert reason in str(refused.value)
    assert str(path) in str(refused.value)
    assert path.read_text() == text


def test_a_state_fits_its_skin_only() -> None:
    def misfit(**present: Any) -> str:
        return STATE.misfit(replace(STATE, **{"skin": "", "scene": "", **present})) or ""

    assert STATE.misfit(STATE) is None
    assert not misfit()
    assert not misfit(simulated=None)
    assert replace(STATE, skin="").misfit(replace(STATE, skin="right palm")) is None
    assert "of skin 'left palm', this is 'right palm'" in misfit(skin="right palm")
    assert "of a simulated skin, this is a real one" in misfit(simulated=False)
    assert "of sim://?scene=idle, this is sim://?scene=" in misfit(scene="sim://?scene=press")
    assert "of 3 nodes, this one has 4" in misfit(nodes=4)
    assert "other curves (calibration 0123456789ab): tare again" in misfit(curves="00000000")


def test_curves_are_told_apart_by_their_checksum() -> None:
    one, other = PressureCurve.two_stage(), PressureCurve.two_stage(v0_v=3.299)
    sums = [Curves.of(pair).checksum for pair in ([one, one], [one, other], [other, one])]
    assert len(set(sums)) == 3
    assert Curves.of([one, other]).checksum == sums[1]
