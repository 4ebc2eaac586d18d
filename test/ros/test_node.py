# SPDX-License-Identifier: Apache-2.0

"""The driver node over real DDS: topics, parameters, lifecycle, faults."""

import re
import time
from itertools import islice
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter as RosParameter
from rclpy.time import Time
from sensor_msgs.msg import Image

from tactile_cdma.config.parameters import PARAMETERS
from tactile_cdma.msg import TactileArray
from tactile_cdma.readings.calibration import AdcScale, PressureCurve
from tactile_cdma.readings.status import Status
from tactile_cdma.ros.common.qos import PICTURE
from tactile_cdma.ros.driver.node import REVIEW_S
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from test.support.skin_client import hurrying, running
from test.support.waiting import wait_for


def test_a_skin_is_described_and_its_frames_are_what_is_pressed_and_when() -> None:
    port = "sim://?scene=hand&seed=11&threshold=0&pitch_mm=10"
    with running(port=port, pitch_mm=10.0) as (_, client):
        wait_for(lambda: client.infos and len(client.arrays) > 100)
        now_ns = time.time_ns()
    pressures_are_those_of_the_simulated_skin(client.arrays, SimOptions.from_url(port))
    stamps_are_the_middle_of_the_code_frame(client.arrays, now_ns)
    info = client.infos[-1]
    assert (info.nodes, info.height, info.width, info.code_order, info.bits) == (16, 4, 4, 20, 10)
    assert list(info.node) == list(range(1, 17))
    assert list(info.code_row) == list(range(1, 17))
    assert info.positions[1].x - info.positions[0].x == pytest.approx(0.010)
    assert info.positions[4].y - info.positions[0].y == pytest.approx(-0.010)
    assert info.pressure_max == pytest.approx(140e3)
    assert info.frame_period == pytest.approx(12.8e-3)
    assert client.arrays[-1].info_id == info.info_id


def pressures_are_those_of_the_simulated_skin(
    arrays: list[TactileArray], options: SimOptions
) -> None:
    sent = list(islice(truth(options, options.setup(Setup())), 400))
    scale, curve = AdcScale(), PressureCurve.two_stage()
    for message in arrays:
        frame = sent[message.sequence]
        assert (message.height, message.width) == (4, 4)
        assert message.header.frame_id == "skin"
        expected = curve.pressure(scale.voltage(frame.codes))
        assert np.allclose(message.pressure, expected, rtol=1e-6, atol=0.05)
        # One count is 0.55 kPa in the second stage.
        assert np.max(np.abs(np.array(message.pressure) - frame.pressure_pa)) < 300
        assert set(message.status) <= {Status.OK, Status.SATURATED}
        assert len(message.voltage) == 0
        assert 0.0015 < message.noise_rms < 0.005  # 5 mV a sample, 4 samples a chip
    sequences = [message.sequence for message in arrays]
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))


def stamps_are_the_middle_of_the_code_frame(arrays: list[TactileArray], now_ns: int) -> None:
    stamps = np.array([Time.from_msg(message.header.stamp).nanoseconds for message in arrays])
    device_us = np.array([message.device_time_us for message in arrays], dtype=float)
    assert (np.diff(stamps) > 0).all()
    # Once the earliest arrivals are known, stamps run with the device's clock.
    error_us = np.diff(stamps[50:]) / 1e3 - np.diff(device_us[50:])
    assert np.median(np.abs(error_us)) < 100
    assert np.median(np.diff(device_us)) == pytest.approx(12_800, abs=2)
    assert 0 < (now_ns - stamps[-1]) * 1e-9 < 1.0


def test_stamps_are_times_also_before_simulated_time_is_told() -> None:
    with running(use_sim_time=True) as (_, client):
        wait_for(lambda: len(client.arrays) > 5)
    stamps_ns = [Time.from_msg(message.header.stamp).nanoseconds for message in client.arrays]
    assert stamps_ns == sorted(set(stamps_ns))
    assert stamps_ns[-1] < 1e6


def test_pictures_keep_coming_while_other_parameters_change_again_and_again() -> None:
    with running(visual_rate_hz=2.0) as (_, client):
        images = client.heard(Image, "/skin/heatmap", PICTURE)
        wait_for(lambda: images)
        before, start = len(images), time.monotonic()
        while len(images) < before + 2:
            assert client.set(mount_xyz_m=[0.0, 0.0, time.monotonic() % 1]) == (True, "")
            assert time.monotonic() - start < 15, "no picture"


def test_parameters_are_described_with_unit_and_range_that_fits_the_slider_of_a_gui() -> None:
    """rqt_reconfigure hands ranges to Qt's, of 32 bits, and shows none that are listed later."""
    with running(autostart=False) as (_, client):
        asked = ListParameters.Request()
        names = client.call(ListParameters, "list_parameters", asked).result.names
        request = DescribeParameters.Request(names=names)
        found = client.call(DescribeParameters, "describe_parameters", request).descriptors
        assert client.set(sign_seed=2**32 - 1) == (True, "")
        assert "it must lie within" in client.set(sign_seed=2**32)[1]
    described = {descriptor.name: descriptor for descriptor in found}
    for parameter in PARAMETERS:
        descriptor = described[parameter.name]
        assert parameter.text in descriptor.description
        assert parameter.unit in descriptor.description
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        is_told = bool(ranges) or "; -1 to 4294967295" in descriptor.additional_constraints
        assert is_told == (parameter.limits is not None)
    assert described["autostart"].read_only
    ranges = [(d.name, r.from_value, r.to_value) for d in found for r in d.integer_range]
    assert ("nodes", 1, 65_535) in ranges
    assert [each for each in ranges if not -(2**31) <= each[1] <= each[2] < 2**31] == []
    assert described["sign_seed"].additional_constraints.endswith("-1 to 4294967295")


def test_parameters_can_be_set_to_what_they_are_and_wrong_values_are_refused_with_a_reason() -> (
    None
):
    """All of them, as by `ros2 param dump` and `load`; and streaming goes on."""
    overrides = {"qos_overrides./skin/tactile.publisher.depth": 7}
    with running(**overrides) as (node, client):
        wait_for(lambda: client.arrays)
        parameters = node.get_parameters_by_prefix("").values()
        declared = [p.name for p in parameters if p.name.startswith("qos_overrides.")]
        assert declared == list(overrides), "only those that are given"
        request = SetParameters.Request(parameters=[p.to_parameter_msg() for p in parameters])
        results = client.call(SetParameters, "set_parameters", request).results
        assert len(results) == len(parameters)
        assert [result.reason for result in results if not result.successful] == []
        for values, reason in (
            ({"active_share": 5.0}, "0.9"),
            ({"active_share": "high"}, "must be a number"),
            ({"colour_max_kpa": -1.0}, "0.1…"),
            ({"nodes": 17}, "cannot change while configured"),
            ({"autostart": False}, "counts only when the node starts"),
            ({"activ_share": 0.4}, "did you mean 'active_share'"),
            ({"threshold": 0.4}, "the parameter threshold is called active_share now"),
            ({"mount_xyz_m": [1.0, 2.0]}, "must be 3 numbers"),
            ({"mount_rpy_rad": [0.0, 0.0, float("nan")]}, "mount_rpy_rad[2] is nan"),
        ):
            taken, why = client.set(**values)
            assert not taken
            assert reason in why
        before = len(client.arrays)
        wait_for(lambda: len(client.arrays) > before + 20)


def test_a_combination_that_cannot_be_is_announced_once_all_are_set(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with running(autostart=False) as (_, client):
        for last, told in ((("nodes", 16), 0), (("bits", 12), 1)):
            given = [("order", 24), ("nodes", 900), ("chip_us", 60.0), last]  # for 23 at most
            parameters = [RosParameter(name, value=v).to_parameter_msg() for name, v in given]
            request = SetParameters.Request(parameters=parameters)
            results = client.call(SetParameters, "set_parameters", request).results
            assert all(result.successful for result in results)
            time.sleep(2 * REVIEW_S)
            said = capfd.readouterr().err
            assert said.count("cannot be configured as it is: ") == told


def test_a_wrong_parameter_at_start_leaves_the_node_alive_until_it_is_corrected() -> None:
    with hurrying(chip_us=-3.0) as (_, client):
        time.sleep(0.5)
        assert client.state() == "unconfigured"
        assert not client.change("configure")
        wait_for(lambda: client.says("chip_us is -3"))
        assert client.arrays == []
        assert client.set(chip_us=50.0) == (True, "")
        wait_for(lambda: client.arrays)


QOS = "qos_overrides./skin/tactile.publisher."
NO_HOME = "~nobody-of-that-name/skin.yaml"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("chip_uss", 40.0, "did you mean 'chip_us'"),
        ("parent_frame", "skin", "they must be two frames"),
        ("parent_frame", "/palm", "parent_frame is '/palm': .* without a leading slash"),
        ("frame_id", "/palm_skin", "frame_id is '/palm_skin': .* without a leading slash"),
        ("layout_file", "package://no_such/a.yaml", "no package 'no_such' in AMENT_PREFIX_PATH"),
        ("calibration_file", "https://a/b.yaml", "package:// or file://, but not with https://"),
        ("state_folder", NO_HOME, f"{NO_HOME}.*the user after ~ has no home"),
        ("calibration_file", NO_HOME, f"{NO_HOME}.*the user after ~ has no home"),
        ("layout_file", NO_HOME, f"{NO_HOME}.*the user after ~ has no home"),
        (f"{QOS}reliability", "best", f"{QOS}.* must be one of .*reliable, best_effort"),
        (f"{QOS}reliability", 3, f"{QOS}.* must be a text, got 3"),
        (f"{QOS}depth", 0, f"{QOS}depth is 0; it must lie within 1…"),
        (f"{QOS}durability", "latched", "one of .*transient_local"),
        (f"{QOS}history", "keep_all", "one of .*keep_last"),  # it would wait for subscribers
    ],
)
def test_a_driver_that_cannot_be_configured_says_why(name: str, value: Any, said: str) -> None:
    with hurrying(**{name: value}) as (_, client):
        wait_for(lambda: any(re.search(said, status.message) for status in client.diagnostics))
        assert client.state() == "unconfigured"
        assert client.arrays == []
