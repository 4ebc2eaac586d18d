# SPDX-License-Identifier: Apache-2.0

"""Tare, drift and calibration of a running driver: services, info, file, over real DDS."""

import os
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import WrenchStamped
from std_srvs.srv import Trigger

from tactile_cdma.msg import TactileArray, TactileContacts
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.rest import rest_keeper
from tactile_cdma.rest.rest_keeper import RestKeeper
from tactile_cdma.ros.client import SkinClient
from tactile_cdma.ros.driver import curves as curve_reader
from tactile_cdma.ros.driver.curves import APART_NODES
from tactile_cdma.sim.scene import SCENES, SkinGeometry
from tactile_cdma.srv import Mask, Tare
from test.support.calibrations import write_calibration
from test.support.programs import started
from test.support.skin_client import Client, hurrying, running
from test.support.spinning import spinning
from test.support.waiting import PATIENCE_S, wait_for

DRIVER = Path(__file__).resolve().parents[2] / "scripts" / "skin_driver"
IDLE = "sim://?scene=idle"
ALL = "sim://?scene=all"
REST_V = 3.3 - 781.25 * 0.033e-3
OFF = "nodes off their rest"


@pytest.fixture
def preload(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Mounts the idle skin under a pressure, Pa; may be called again while it runs."""
    load_pa = [0.0]

    def scene(t_s: float, skin: SkinGeometry) -> np.ndarray:
        return np.full(len(skin.positions_m), load_pa[0])

    def mount(pressure_pa: float) -> None:
        load_pa[0] = pressure_pa

    monkeypatch.setitem(SCENES, "idle", scene)
    return mount


def tare(client: Client, **request: bool) -> Tare.Response:
    response: Tare.Response = client.call(Tare, "tare", Tare.Request(**request))
    return response


def tare_at_last(client: Client, **request: bool) -> Tare.Response:
    """As soon as every node has been heard for a second."""
    wait_for(lambda: len(client.arrays) > 90)
    while "try again" in (response := tare(client, **request)).message:
        time.sleep(0.1)
    return response


def has_no_gap(arrays: list[TactileArray]) -> bool:
    """Whether no frame is missing next to a change: elsewhere a busy machine may lose some."""
    steps = [(b.info_id - a.info_id, b.sequence - a.sequence) for a, b in pairwise(arrays)]
    changes = [number for number, (change, _) in enumerate(steps) if change]
    return all(step == 1 for at in changes for _, step in steps[max(0, at - 5) : at + 2])


def test_a_tare_shows_in_readings_info_and_file_and_no_frame_is_lost(
    preload: Callable[[float], None], tmp_path: Path
) -> None:
    preload(800.0)
    with running(port=IDLE, state_folder=str(tmp_path)) as (_, client):
        response = tare_at_last(client)
        assert response.success, response.message
        wait_for(lambda: client.arrays[-1].info_id == 2)
        wait_for(lambda: len(client.infos) == 2)
        later = len(client.arrays) + 20
        wait_for(lambda: len(client.arrays) > later)
    assert "0.78 to 0.78 kPa are taken off" in response.message
    assert np.allclose(response.offset, 781.25, atol=1)  # eight counts
    assert list(client.infos[0].tare) == []
    assert client.infos[1].info_id == 2
    assert np.allclose(client.infos[1].tare, response.offset)
    for message in client.arrays[30:]:
        expected = 781.25 if message.info_id == 1 else 0.0
        assert np.allclose(message.pressure, expected, atol=15), message.sequence
    assert {message.info_id for message in client.arrays} == {1, 2}
    assert has_no_gap(client.arrays)
    [path] = tmp_path.iterdir()
    assert path.name == "skin-simulated.rest.yaml"
    assert np.allclose(yaml.safe_load(path.read_text())["rest_v"], REST_V)
    with running(port=IDLE, state_folder=str(tmp_path)) as (_, client):
        for _ in range(2):  # the next one takes it over, and keeps it from stream to stream
            before = len(client.arrays)
            wait_for(lambda before=before: len(client.arrays) > before + 10)
            assert np.allclose(client.arrays[-1].pressure, 0, atol=15)
            wait_for(lambda: np.allclose(client.infos[-1].tare, 781.25, atol=1))
            assert client.change("deactivate", "activate")


def test_a_tare_under_load_is_refused_unless_forced_and_can_be_cleared(tmp_path: Path) -> None:
    with running(port=ALL, state_folder=str(tmp_path)) as (_, client):
        refused = tare_at_last(client)
        assert not refused.success
        assert "node 16 (row 3, column 3)" in refused.message
        assert "moving" in refused.message or "force: true" in refused.message
        assert not any(refused.offset)
        assert list(tmp_path.iterdir()) == []
        forced = tare(client, force=True)
        assert forced.success and min(forced.offset) > 10e3
        wait_for(lambda: client.arrays[-1].info_id == 2)
        assert min(client.arrays[-1].pressure) < 10e3
        cleared = tare(client, clear=True)
        assert cleared.success and not any(cleared.offset)
        wait_for(lambda: client.arrays[-1].info_id == 3)
        assert min(client.arrays[-1].pressure) > 10e3
        wait_for(lambda: len(client.infos) == 3)
    assert [len(info.tare) for info in client.infos] == [0, 16, 0]
    assert yaml.safe_load((tmp_path / "skin-simulated.rest.yaml").read_text())["rest_v"] is None


def test_all_goes_with_force() -> None:
    requests: tuple[tuple[dict[str, bool], bool | str], ...] = (
        ({}, False),
        ({"force": True}, True),
        ({"force": True, "all": True}, "all"),
        ({"all": True}, False),
    )
    tared = mock.patch.object(RestKeeper, "tare", autospec=True, side_effect=RestKeeper.tare)
    with running(port=IDLE) as (_, client), tared as calls:
        skin = SkinClient(client)
        for request, force in requests:
            calls.reset_mock()
            tare_at_last(client, **request)
            if force:
                assert skin.tare(force).success
            assert {call.args[1] for call in calls.call_args_list} == {force}


def test_services_answer_in_every_state(tmp_path: Path) -> None:
    def save() -> Trigger.Response:
        response: Trigger.Response = client.call(Trigger, "save_calibration", Trigger.Request())
        return response

    with running(port=IDLE, state_folder=str(tmp_path), autostart=False) as (_, client):
        assert "not active" in tare(client).message
        assert "not configured" in save().message
        assert client.change("configure")
        assert "not active" in tare(client).message
        assert save().success
        assert client.change("activate")
        response = tare(client)
        assert not response.success
        assert "not tared" in response.message
        (tmp_path / "skin-simulated.rest.yaml").unlink()
        saved = save()
        assert saved.success
        for name in ("skin-simulated.rest.yaml", "skin-simulated.calibration.yaml"):
            assert str(tmp_path / name) in saved.message
            assert (tmp_path / name).exists()
        assert client.change("deactivate")
        assert "not active" in tare(client).message


def test_what_is_off_its_rest_the_tare_and_drift_are_told_of_while_frames_come(
    preload: Callable[[float], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once tared, the skin rests a count off; at this rate following that takes no time."""
    monkeypatch.setattr(rest_keeper, "TELL_S", 0.1)
    monkeypatch.setattr("tactile_cdma.readings.drift.SETTLE_S", 0.5)
    monkeypatch.setattr("tactile_cdma.readings.drift.STRAY_S", 0.5)

    def values() -> dict[str, str]:
        return {pair.key: pair.value for pair in client.diagnostics[-1].values}

    preload(800.0)
    with hurrying(port=IDLE, state_folder=str(tmp_path)) as (_, client):
        wait_for(lambda: client.diagnostics and "1 (+8.0 LSB), 2" in values()[OFF])
        assert values()[OFF].endswith("16 (+8.0 LSB); tare if nothing touches them")
        assert values()["tared"] == "not"
        assert tare_at_last(client).success
        wait_for(lambda: values()[OFF] == "")
        assert values()["tared"].startswith("20")
        assert values()["largest drift (mV)"] == "0.00, node 1"
        assert client.set(drift_pa_per_min=0.0) == (True, "")
        preload(920.0)
        wait_for(lambda: np.allclose(client.arrays[-1].pressure, 97.66, atol=1))
        assert client.set(drift_pa_per_min=1e4) == (True, "")
        wait_for(lambda: len(client.infos) == 3)
        assert np.allclose(client.infos[2].drift, 3.3 / 1024, rtol=0.1)
        wait_for(lambda: client.arrays[-1].info_id == client.infos[2].info_id == 3)
        wait_for(lambda: np.allclose(client.arrays[-1].pressure, 0, atol=2))
    state = yaml.safe_load((tmp_path / "skin-simulated.rest.yaml").read_text())
    assert np.allclose(state["drift_v"], 3.3 / 1024, rtol=0.1)


MANY = {"nodes": APART_NODES, "chip_us": 4.0, "frame_period_ms": 20.0, "samples_per_chip": 1}


def readers(process: int) -> list[int]:
    """A process's readers that run their own program; one stopped before stops its parent, too."""
    found = []
    for children in Path(f"/proc/{process}/task").glob("*/children"):
        with suppress(OSError):  # a thread has ended, or a child
            for child in children.read_text().split():
                if curve_reader.READER.encode() in Path(f"/proc/{child}/cmdline").read_bytes():
                    found.append(int(child))
    return found


def test_thousands_of_curves_are_read_apart_from_the_stream_and_refused_if_they_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The driver looks after the reader long before that has begun, as on a busy computer."""
    monkeypatch.setattr(curve_reader, "WAKE_S", 1e-3)
    monkeypatch.setattr(curve_reader, "READ_S", PATIENCE_S)
    curves = Calibration.default(PressureCurve.two_stage(stage1_v_per_pa=0.03e-3), APART_NODES)
    path, bad = tmp_path / "curves.yaml", tmp_path / "bad.yaml"
    identity = write_calibration(path, curves, AdcScale())
    bad.write_text(path.read_text().replace("curves:", "curvs:"))
    with running(port=IDLE, state_folder=str(tmp_path), **MANY) as (_, client):
        wait_for(lambda: len(client.arrays) > 10)
        taken, why = client.set(calibration_file=str(bad))
        assert not taken and "unknown key 'curvs' in the file; did you mean 'curves'?" in why
        with monkeypatch.context() as change:
            change.setattr(sys, "executable", "/no/python")
            taken, why = client.set(calibration_file=str(path))
        assert not taken and "its reader cannot begin: " in why and "/no/python" in why
        for sent, read_s, reason in (
            (signal.SIGKILL, PATIENCE_S, "its reader was killed; is memory short"),
            (signal.SIGSTOP, 2.0, "not read in 2 s"),
        ):
            with monkeypatch.context() as change, ThreadPoolExecutor(1) as thread:
                change.setattr(curve_reader, "READ_S", read_s)
                answer = thread.submit(client.set, calibration_file=str(path))
                wait_for(lambda: readers(os.getpid()))
                for reader in readers(os.getpid()):
                    os.kill(reader, sent)
                taken, why = answer.result(PATIENCE_S)
            assert not taken and why.startswith(f"{path}: ") and reason in why
            assert not readers(os.getpid())
        assert client.set(calibration_file=str(path)) == (True, "")
        wait_for(lambda: client.arrays[-1].info_id == 2)
    assert client.infos[-1].calibration_id == identity
    assert has_no_gap(client.arrays)


def test_a_driver_whose_reader_hangs_is_ended_by_a_signal(tmp_path: Path) -> None:
    """As where the disk of the file has gone."""
    path = tmp_path / "curves.yaml"
    write_calibration(path, Calibration.default(PressureCurve.two_stage(), APART_NODES), AdcScale())
    values = {"port": IDLE, "state_folder": tmp_path, **MANY}
    words = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    client = Client()
    with (
        started([sys.executable, DRIVER, "--ros-args", *words]) as driver,
        spinning([client]),
        ThreadPoolExecutor(1) as thread,
    ):
        wait_for(lambda: len(client.arrays) > 10)
        thread.submit(client.set, calibration_file=str(path))
        wait_for(lambda: readers(driver.pid))
        for reader in readers(driver.pid):
            os.kill(reader, signal.SIGSTOP)
        driver.terminate()
        assert driver.wait(curve_reader.READ_S / 2) == 0


def test_curves_are_read_while_frames_go_on_the_tare_stays_and_a_bad_file_changes_nothing(
    preload: Callable[[float], None], tmp_path: Path
) -> None:
    """At first those in force, as they are saved, again and again."""
    preload(800.0)
    same = tmp_path / "skin-simulated.calibration.yaml"
    steep = Calibration.default(PressureCurve.two_stage(stage1_v_per_pa=0.066e-3, knee_pa=24e3), 16)
    path, bad = tmp_path / "steep.yaml", tmp_path / "bad.yaml"
    identity = write_calibration(path, steep, AdcScale())
    bad.write_text(path.read_text().replace("nodes: 16", "nodes: 17"))
    with running(port=IDLE, state_folder=str(tmp_path)) as (_, client):
        assert tare_at_last(client).success
        for file, reason in (
            (bad, "line"),
            (tmp_path / "none.yaml", "No such file"),
            ("~nobody-of-that-name/skin.yaml", "the user after ~ has no home"),
        ):
            taken, why = client.set(calibration_file=str(file))
            assert not taken and str(file) in why and reason in why
        assert client.arrays[-1].info_id == 2
        assert client.call(Trigger, "save_calibration", Trigger.Request()).success
        for number, (file, tare_pa) in enumerate([*[(same, 781.25)] * 3, (path, 781.25 / 2)], 3):
            assert client.set(calibration_file=str(file)) == (True, "")
            wait_for(lambda number=number: client.infos[-1].info_id == number)
            wait_for(lambda number=number: client.arrays[-1].info_id == number)
            assert np.allclose(client.arrays[-1].pressure, 0, atol=15)
            assert np.allclose(client.infos[-1].tare, tare_pa, atol=15)
            assert client.infos[-1].calibration_id != client.infos[0].calibration_id == ""
        assert client.infos[-1].calibration_id == identity
        assert client.set(calibration_file="") == (True, "")
        taken, why = client.set(knee_kpa=141.0)
        assert not taken and "knee" in why
        assert client.set(sensitivity1_v_per_kpa=0.0165) == (True, "")
        wait_for(lambda: len(client.infos) == 8 and client.arrays[-1].info_id == 8)
        assert np.allclose(client.infos[-1].tare, 781.25 * 2, atol=30)
    assert has_no_gap(client.arrays)
    kept = yaml.safe_load((tmp_path / "skin-simulated.rest.yaml").read_text())
    assert np.allclose(kept["rest_v"], REST_V)


DEAD = "sim://?scene=idle&heartbeat=20&dead=3"


class Watch:
    """What a control loop hears of a skin."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.wrenches = client.heard(WrenchStamped, "/skin/wrench", 100)
        self.contacts = client.heard(TactileContacts, "/skin/contacts", 100)

    def mask(self, *nodes: int, clear: bool = False) -> Mask.Response:
        response: Mask.Response = self.client.call(
            Mask, "mask", Mask.Request(nodes=nodes, clear=clear)
        )
        return response

    def wait(self, in_service: int, knows: bool, **info: list[int]) -> None:
        """Wait until messages and info say so."""

        def says() -> bool:
            told = self.client.infos[-1]
            there = all(list(getattr(told, name)) == nodes for name, nodes in info.items())
            if not (self.contacts and self.wrenches and there):
                return False
            newest: Any = self.contacts[-1]
            is_nan = np.isnan(self.wrenches[-1].wrench.force.z)
            seen = newest.taxels_in_service, newest.untouched, bool(is_nan)
            return seen == (in_service, knows, not knows) and newest.info_id == told.info_id

        wait_for(says)


def test_a_dead_taxel_that_is_masked_holds_up_the_wrench_no_more_also_after_a_restart(
    tmp_path: Path,
) -> None:
    with running(port=DEAD, state_folder=str(tmp_path)) as (_, client):
        watch = Watch(client)
        watch.wait(16, False, masked=[])
        assert not watch.mask(17).success
        answer = watch.mask(3)
        assert answer.success and list(answer.masked) == [3]
        watch.wait(15, True, masked=[3])
    with running(port=DEAD, state_folder=str(tmp_path)) as (_, client):
        watch = Watch(client)
        watch.wait(15, True, masked=[3])
        assert client.set(masked="3, 4")[0]
        watch.wait(14, True, masked=[3, 4])
        refused = watch.mask(4, clear=True)
        assert not refused.success and "parameter" in refused.message
        assert client.set(masked="")[0]
        answer = watch.mask(clear=True)
        assert answer.success and list(answer.masked) == []
        watch.wait(16, False, masked=[])
        assert not client.set(masked="17")[0]


def test_a_dead_taxel_is_left_out_only_where_that_is_asked_for_and_all_is_told() -> None:
    with hurrying(port=DEAD, stale_after_s=0.5) as (_, client):
        watch = Watch(client)
        wait_for(lambda: "node 3" in client.entry("nodes").message)
        watch.wait(16, False, retired=[])
        assert client.set(dead_share=0.1)[0]
        watch.wait(15, True, retired=[3], masked=[])
        wait_for(lambda: client.says("out of service, as dead_share allows: node 3"))
        assert client.set(dead_share=0.06)[0]  # less than one of 16
        watch.wait(16, False, retired=[])


def test_how_sure_a_reading_is_comes_with_it_while_that_is_asked_for(tmp_path: Path) -> None:
    curve = replace(PressureCurve.two_stage(), residual_v=2e-3, loop=0.05)
    path = tmp_path / "known.yaml"
    write_calibration(path, Calibration.default(curve, 16), AdcScale())
    with running(port="sim://?scene=all&threshold=0", calibration_file=str(path)) as (_, client):
        user = SkinClient(client, "/skin", frames=True)
        wait_for(lambda: user.frame is not None)
        assert user.frame is not None and not len(user.frame.sigma_pa)
        assert client.set(publish_sigma=True)[0]
        wait_for(lambda: user.frame is not None and len(user.frame.sigma_pa) == 16)
        frame = user.frame
        assert (frame.sigma_pa > 0.04 * frame.pressure_pa).all()
        assert (frame.sigma_pa < 0.1 * frame.pressure_pa + 1e3).all()
        assert client.set(publish_sigma=False)[0]
        wait_for(lambda: user.frame is not None and not len(user.frame.sigma_pa))
