# SPDX-License-Identifier: Apache-2.0

"""Recordings replayed by a real node, and bags of them, read by another library."""

from functools import partial
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.messages.types import message_types
from tactile_cdma.recording.offline import described_parameters, raw_frames
from tactile_cdma.sim.options import SimOptions
from test.support import simulated
from test.support.skin_client import running
from test.support.waiting import wait_for

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


def test_a_node_replays_a_recording_as_decode_reads_it_and_a_bag_has_it(tmp_path: Path) -> None:
    """The bag knows our types as ROS does, by their hashes, or others take them for other types."""
    path = simulated.recording(tmp_path / "touch.skin", SimOptions.from_url(PORT), 1.5)
    values = {**described_parameters(path), "amplitude_mv": 300.0}
    pipeline = Pipeline(SkinConfig.of(values))
    offline = {frame.sequence: frame for frame in raw_frames(path, pipeline)}
    with running(port=f"replay://{path}?speed=1", publish_voltage=True) as (_, client):
        for topic in ("tactile", "info", "contacts"):
            offers = partial(client.get_publishers_info_by_topic, f"/skin/{topic}")
            wait_for(offers)
            offer, *_ = offers()  # those of earlier tests may not be forgotten yet
            digest = bytes(offer.topic_type_hash.value).hex()
            assert message_types().hash_rihs01(offer.topic_type) == f"RIHS01_{digest}"
        wait_for(lambda: client.says("recording has ended"))
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
