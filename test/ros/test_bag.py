# SPDX-License-Identifier: Apache-2.0

"""Bags recorded from a live skin, read by another library; recordings replayed by a real node."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from std_srvs.srv import Trigger

from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.recording.offline import described_parameters, raw_frames
from tactile_cdma.ros.bag import DATA, PICTURES, SHARED, arguments_of, topics_of
from tactile_cdma.srv import Tare
from test.support.skin_client import running
from test.support.waiting import PATIENCE_S, wait_for

pytestmark = pytest.mark.xdist_group("bag")
ROOT = Path(__file__).resolve().parents[2]
PORT = "sim://?scene=moving&seed=6&dead=3"


def assert_same(read: object, live: object) -> None:
    """All fields of a message, whichever library made them; NaN is NaN."""
    for name in live.get_fields_and_field_types():
        one, other = getattr(read, name), getattr(live, name)
        if one is other:
            continue
        if hasattr(other, "get_fields_and_field_types"):
            assert_same(one, other)
        elif isinstance(other, list):
            assert len(one) == len(other)
            for mine, theirs in zip(one, other, strict=True):
                assert_same(mine, theirs)
        else:
            np.testing.assert_array_equal(one, other, strict=False)


def test_a_bag_holds_what_a_subscriber_got_and_ends_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    with running(port=PORT) as (_, client):
        wait_for(lambda: client.arrays)
        process = subprocess.Popen(
            [sys.executable, "-m", "tactile_cdma.ros.bag", str(folder)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        try:
            assert "recording into" in process.stdout.readline()
            for topic in ("tactile", "info", "contacts"):  # discovery takes its time
                others = int(topic != "contacts")
                wait_for(lambda t=topic, n=others: client.count_subscribers(f"/skin/{t}") > n)
            begin = len(client.arrays)
            wait_for(lambda: len(client.arrays) > begin + 150)
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE_S) == 0
            summary = process.stdout.read()
        finally:
            process.kill()
            process.stdout.close()
        live = {message.sequence: message for message in client.arrays}
        live_info = client.infos[0]
    assert "/skin/tactile: " in summary
    with AnyReader([folder]) as reader:  # knows our messages by the bag alone
        connections = {connection.topic: connection for connection in reader.connections}
        assert {"/skin/tactile", "/skin/info", "/skin/contacts", "/diagnostics"} <= set(connections)
        matched = silent = 0
        for connection, stamp_ns, raw in reader.messages([connections["/skin/tactile"]]):
            message = reader.deserialize(raw, connection.msgtype)
            sent_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert 0 < stamp_ns - sent_ns < 10e9
            assert np.isnan(message.pressure[2]) and np.isfinite(message.pressure).any()
            silent += int(message.status[2] & message.STATUS_SILENT)
            if message.sequence in live:
                assert_same(message, live[message.sequence])
                matched += 1
        assert matched > 50 and silent > 50
        infos = list(reader.messages([connections["/skin/info"]]))
        info = reader.deserialize(infos[0][2], infos[0][0].msgtype)
        assert_same(info, live_info)  # latched: it was published before
        [offered] = connections["/skin/info"].ext.offered_qos_profiles
        assert offered.durability == QosDurability.TRANSIENT_LOCAL
        [offered] = connections["/skin/tactile"].ext.offered_qos_profiles
        assert offered.reliability == QosReliability.BEST_EFFORT
        assert "float32[] pressure" in connections["/skin/tactile"].msgdef.data


SMALL_DISK = (
    "mount -t tmpfs -o size=67m none {disk} && {bag} {disk}/bag --topics /skin/heatmap; code=$?;"
    "cp -r {disk}/bag {kept} && exit $code"
)


def test_a_bag_ends_whole_before_the_disk_is_full(tmp_path: Path) -> None:
    """On a file system of its own, which has 3 MB more than is to be left."""
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode:
        pytest.skip("nothing can be mounted here")
    disk, kept = tmp_path / "disk", tmp_path / "kept"
    disk.mkdir()
    bag = f"{sys.executable} -m tactile_cdma.ros.bag"
    script = SMALL_DISK.format(disk=disk, kept=kept, bag=bag)
    with running(port=PORT, heatmap_pixels=64) as (_, client):
        wait_for(lambda: client.arrays)
        command = ["unshare", "-rm", "sh", "-c", script]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 1
    [complaint] = done.stderr.splitlines()
    assert "ended here, whole: less than 64 MB are left on the disk" in complaint
    with AnyReader([kept]) as reader:
        count = sum(1 for _ in reader.messages())
    assert count > 5 and f"/skin/heatmap: {count}" in done.stdout


@pytest.mark.parametrize(
    ("options", "recorded"),
    [
        ("", {"/skin/tactile", "/skin/info", "/skin/contacts", "/skin/wrench", *SHARED}),
        ("--topics joint_states /a", {"/joint_states", "/a"}),
        (
            "--node left/skin --topics /joint_states",
            {f"/left/skin/{name}" for name in DATA} | {"/joint_states", *SHARED},
        ),
        (
            "--all --topics /joint_states",
            {f"/skin/{name}" for name in DATA + PICTURES} | {"/joint_states", *SHARED},
        ),
    ],
)
def test_a_named_skin_is_recorded_whatever_else_is(options: str, recorded: set[str]) -> None:
    assert set(topics_of(arguments_of(["bag", *options.split()]))) == recorded


def test_an_invalid_topic_name_is_one_clear_error(tmp_path: Path) -> None:
    for options in (["--topics", "two words"], ["--node", ""]):
        command = [sys.executable, "-m", "tactile_cdma.ros.bag", str(tmp_path / "bag"), *options]
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S)
        assert run.returncode == 1
        assert "is not a valid topic name" in run.stderr and len(run.stderr.splitlines()) == 1
    assert not (tmp_path / "bag").exists()


def test_without_rosbags_skin_bag_is_one_clear_error(tmp_path: Path) -> None:
    start = "import runpy, sys; sys.modules['rosbags'] = None; runpy.run_path(sys.argv[1])"
    command = [sys.executable, "-c", start, str(ROOT / "scripts" / "skin_bag"), str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert run.returncode == 1
    assert run.stderr.startswith("skin_bag needs the Python package rosbags, which is")
    assert "pip install rosbags" in run.stderr and len(run.stderr.splitlines()) == 1


def test_the_bag_knows_our_types_as_ros_does(tmp_path: Path) -> None:
    """By their hashes, or others take them for other types."""
    from tactile_cdma.messages.types import message_types

    with running(port=PORT) as (_, client):
        wait_for(lambda: client.arrays and client.infos)
        for topic in ("tactile", "info", "contacts"):
            [offer] = client.get_publishers_info_by_topic(f"/skin/{topic}")
            digest = bytes(offer.topic_type_hash.value).hex()
            assert message_types().hash_rihs01(offer.topic_type) == f"RIHS01_{digest}"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    path, params = folder / "touch.skin", folder / "skin.yaml"
    params.write_text("skin:\n  ros__parameters:\n    nodes: 16\n")
    assert main(["record", PORT, str(path), "--seconds", "1.5", "--params", str(params)]) == 0
    return path


def test_a_node_replays_a_recording_as_decode_reads_it(recording: Path, tmp_path: Path) -> None:
    path = recording
    values = {**described_parameters(path), "amplitude_mv": 300.0}
    pipeline = Pipeline(SkinConfig.of(values), background=False)
    offline = {frame.sequence: frame for frame in raw_frames(path, pipeline)}
    with running(port=f"replay://{path}?speed=1", publish_voltage=True) as (_, client):
        wait_for(lambda: any("recording has ended" in d.message for d in client.diagnostics))
    assert len(client.arrays) > 80
    assert main(["export", str(path), "--bag", "-o", str(tmp_path / "bag")]) == 0
    with AnyReader([tmp_path / "bag"]) as reader:
        [info] = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
            if connection.topic == "/skin/info"
        ]
    live = client.infos[0]
    info.header, info.info_id = live.header, live.info_id  # times and counts of another program
    assert_same(info, live)
    for message in client.arrays:
        frame = offline[message.sequence]
        assert message.device_time_us == round(frame.t_middle * 1e6)
        assert np.array(message.pressure).tobytes() == frame.readings.pressure_pa.tobytes()
        assert np.array(message.voltage).tobytes() == frame.readings.voltage_v.tobytes()
        assert np.array(message.status).tobytes() == frame.readings.status.tobytes()


def test_a_replay_leaves_no_tare_behind(recording: Path, tmp_path: Path) -> None:
    with running(port=f"replay://{recording}?loop=true", state_folder=str(tmp_path)) as (_, client):
        tare = Tare.Request(force=True)
        wait_for(lambda: client.call(Tare, "tare", tare).success)  # takes a second of frames
        wait_for(lambda: any(client.infos[-1].tare))
        answer = client.call(Trigger, "save_calibration", Trigger.Request())
        assert not answer.success and "not kept" in answer.message
        client.arrays.clear()
        assert client.change(Transition.TRANSITION_DEACTIVATE)
        assert client.change(Transition.TRANSITION_ACTIVATE)
        wait_for(lambda: len(client.arrays) > 5 and not client.infos[-1].tare)
    assert list(tmp_path.iterdir()) == []
