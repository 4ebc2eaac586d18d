# SPDX-License-Identifier: Apache-2.0

"""The parameter table, parameter files and the configuration made from them."""

import os
import subprocess
import sys
from array import array
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.errors import ParameterError, SpecError
from tactile_cdma.config.arguments import check_params_are_for, launch_values
from tactile_cdma.config.parameters import BY_NAME, PARAMETERS, SIMULATION, check_values, read_file
from tactile_cdma.config.skin_config import SkinConfig
from test.support.calibrations import write_calibration

ROOT = Path(__file__).resolve().parents[3]
ARGUMENTS = {"port": "", "params_file": "skin.yaml", "sim": "false", "namespace": ""}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"prot": "/dev/x"}, "unknown launch argument 'prot'; did you mean 'port'? (there are "),
        ({"sim": "true", "param_file": "a.yaml"}, "did you mean 'params_file'"),
        ({"PORT": "x:=y"}, "unknown launch argument 'PORT'; did you mean 'port'"),
        ({"xyz": ""}, "'xyz' (there are namespace, params_file, port, sim, and the parameters"),
        ({"node": "9"}, "did you mean 'nodes'"),
        ({"threshold": "9"}, "the launch argument threshold is called active_share now"),
        (
            {"roll_call": "true"},
            "the launch argument roll_call is gone: nodes keep time by the sync line",
        ),
        ({"nodes": "many"}, "nodes must be an integer, got 'many'"),
        ({"nodes": "0"}, "nodes is 0; it must lie within"),
        ({"mount_xyz_m": "1, 2"}, "it must be 3 numbers"),
        ({"use_sim_time": "often"}, "use_sim_time is 'often'; it must be true or false"),
    ],
)
def test_a_launch_argument_that_is_none_is_refused(given: dict[str, str], message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        launch_values(given, ARGUMENTS)
    assert message in str(caught.value)


def test_launch_takes_its_own_arguments_and_every_parameter_by_its_name() -> None:
    given = {"port": "socket://a:1", "nodes": "64", "chip_us": "20", "skin": "7", "parity": "Yes"}
    given |= {"mount_xyz_m": "[0, 0.1, 1e-2]", "use_sim_time": "True"}
    own, values = launch_values(given, ARGUMENTS)
    assert own == ARGUMENTS | {"port": "socket://a:1"}
    assert values == {
        "nodes": 64,
        "chip_us": 20.0,
        "skin": "7",
        "parity": True,
        "mount_xyz_m": (0.0, 0.1, 0.01),
        "use_sim_time": True,
    }
    assert type(values["chip_us"]) is float


def test_nothing_shipped_asks_for_a_simulator_without_naming_it() -> None:
    assert BY_NAME["port"].default == ""
    for path in (ROOT / "config").glob("*skin.yaml"):
        assert not str(read_file(path).get("port", "")).startswith(SIMULATION)


def test_all_skins_but_the_papers_are_scrambled() -> None:
    files = [path for path in (ROOT / "config").glob("*.yaml") if "body" not in path.name]
    specs = {path.name: SkinConfig.of(read_file(path)).spec for path in files}
    assert {name for name, spec in specs.items() if not spec.scramble} == {"paper_skin.yaml"}


def test_every_default_lies_within_its_own_limits() -> None:
    for parameter in PARAMETERS:
        assert parameter.check(parameter.default) == parameter.default
    assert SkinConfig.of({}).spec.nodes == 16


def test_a_calibration_is_read_anew_without_the_other_files(tmp_path: Path) -> None:
    layout, calibration = tmp_path / "layout.yaml", tmp_path / "calibration.yaml"
    layout.write_text((ROOT / "config/layouts/grid.yaml").read_text())
    files = {"layout_file": str(layout), "calibration_file": str(calibration)}
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    config = SkinConfig.of({"nodes": 12, "layout_file": str(layout)})
    identity = write_calibration(calibration, config.calibration, config.adc)
    layout.write_text("being edited: [")
    again = config.recalibrated({**values, "nodes": 12, **files})
    assert again.calibration.identity == identity
    assert again.layout is config.layout


def test_the_shipped_file_is_the_default_configuration_scrambled() -> None:
    shipped = SkinConfig.of(read_file(ROOT / "config" / "skin.yaml"))
    default = SkinConfig.of({"scramble": True})
    for name in (field.name for field in fields(SkinConfig)):
        if name not in ("calibration", "layout"):  # arrays
            assert getattr(shipped, name) == getattr(default, name)
    assert np.array_equal(shipped.layout.positions_m, default.layout.positions_m)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"chip_uss": 50.0}, "unknown parameter 'chip_uss'; did you mean 'chip_us'"),
        ({"nodes": "16"}, "nodes must be an integer, got '16'"),
        ({"nodes": True}, "nodes must be an integer"),
        ({"bits": 10.0}, "bits must be an integer"),
        ({"parity": 2}, "parity must be true or false, got 2"),
        ({"chip_us": -1.0}, "chip_us is -1 µs; it must lie within 0.01…1e.06 µs"),
        ({"chip_us": float("nan")}, "chip_us is nan"),
        ({"drive": "uni"}, "drive is 'uni'; it must be one of bipolar, unipolar"),
        ({"polarity": 2}, "polarity is 2; it must be one of 1, -1"),
        ({"mount_xyz_m": 1.0}, "mount_xyz_m must be a list of numbers, got 1.0"),
        ({"mount_xyz_m": [1.0, 2.0]}, r"mount_xyz_m is \[1.0, 2.0\]; it must be 3 numbers"),
        ({"mount_xyz_m": [0.0, "1", 0.0]}, r"mount_xyz_m\[1\] must be a number, got '1'"),
        ({"mount_rpy_rad": [0.0, 0.0, float("nan")]}, r"mount_rpy_rad\[2\] is nan rad"),
        ({"mount_rpy_rad": [0, 90, 0]}, r"mount_rpy_rad\[1\] is 90 rad; it must lie within -10…10"),
    ],
)
def test_bad_values_are_refused_with_value_and_limit(values: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        SkinConfig.of(values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"nodes": 64, "frame_period_ms": 12.9}, "longer than its period"),
        ({"timing": "gap", "samples_per_chip": 1}, "samples_per_chip is 1, it must be 3 or more"),
        ({"timing": "gap", "frame_period_ms": 11.0}, "silence between frames"),
        ({"rows": 3, "columns": 3}, "9 places for 16 nodes"),
        ({"knee_kpa": 200.0}, "knee"),
    ],
)
def test_impossible_combinations_are_refused(values: dict, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        SkinConfig.of(values)


@pytest.mark.parametrize("name", ["nodes", "port", "drive", "mount_xyz_m", "parity"])
def test_a_refusal_is_short_however_much_was_sent(name: str) -> None:
    for value in ("x" * 1_000_000, array("d", bytes(800_000)), ["x" * 1_000_000] * 3):
        if name == "port" and isinstance(value, str):
            continue
        with pytest.raises(ParameterError) as refusal:
            check_values({name: value})
        assert len(str(refusal.value)) < 300
        assert "array(" not in str(refusal.value)


def test_integers_are_accepted_as_numbers() -> None:
    assert check_values({"chip_us": 50}) == {"chip_us": 50.0}
    for given in ([1, 2.5, 3], (1.0, 2.5, 3.0), array("d", [1, 2.5, 3])):
        assert check_values({"mount_xyz_m": given}) == {"mount_xyz_m": (1.0, 2.5, 3.0)}


def test_zero_amplitude_means_learnt_and_minus_one_natural_signs() -> None:
    spec = SkinConfig.of({"amplitude_mv": 0.0, "sign_seed": -1}).spec
    assert spec.amplitude_v is None
    assert spec.sign_seed is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nodes: 16", "no 'ros__parameters' section"),
        ("/**: {ros__parameters: {nodess: 3}}", "did you mean 'nodes'"),
        (
            "/**: {ros__parameters: {roll_call: false}}",
            "line 1: the parameter roll_call is gone: nodes keep time by the sync line now",
        ),
        ("/**: {ros__parameters: {nodes: 0}}", "nodes is 0"),
        ("/**:\n  ros__parameters:\n    bits: 99\n", "line 3: bits is 99"),
        ("/**: {ros__parameters: {skin: {a: 1}}}", "keys with values"),
        ("/**: {ros__parameters: {skin: 2001-99-99, nodes: ~}}", "nodes must be an integer"),
        ("/**: {ros__parameters: {nodes: " + "9" * 5000 + "}}", "nodes must be an integer"),
        ("/**: {ros__parameters: {nodes: 010}}", "nodes must be an integer"),
    ],
)
def test_broken_files_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ParameterError, match=message) as caught:
        read_file(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("key", "node"),
    [
        ("/**", "/left/skin"),
        ("skin", "/skin"),
        ("/left/skin", "/left/skin"),
        ("/*/skin", "/left/skin"),
        ("/left/**", "/left/skin"),
    ],
)
def test_a_node_takes_the_sections_that_fit_its_name(tmp_path: Path, key: str, node: str) -> None:
    path = tmp_path / "names.yaml"
    path.write_text(f"{key}: {{ros__parameters: {{bits: 12}}}}\nother: {{ros__parameters: {{}}}}\n")
    assert read_file(path, node) == read_file(path) == {"bits": 12}
    with pytest.raises(ParameterError, match="this node is /elsewhere/palm: write /elsewhere/palm"):
        path.write_text(f"{key.replace('*', 'x')}: {{ros__parameters: {{bits: 12}}}}")
        read_file(path, "/elsewhere/palm")


def test_of_sections_that_fit_the_last_one_counts_as_in_ros(tmp_path: Path) -> None:
    path = tmp_path / "names.yaml"
    path.write_text("skin: {ros__parameters: {bits: 12}}\n/**: {ros__parameters: {bits: 11}}\n")
    assert read_file(path, "/skin") == {"bits": 11}


def test_of_the_files_of_a_command_line_one_has_to_be_for_the_node(tmp_path: Path) -> None:
    ours, others = tmp_path / "ours.yaml", tmp_path / "others.yaml"
    ours.write_text("skin: {ros__parameters: {bits: 12}}")
    others.write_text("/arm: {ros__parameters: {joints: 7}}")
    for files in ([], [ours], [others, ours]):
        words = [word for file in files for word in ("--params-file", str(file))]
        check_params_are_for("/skin", ["skin_driver", "--ros-args", *words])
    with pytest.raises(ParameterError, match=r"others\.yaml, line 1: .* for /arm"):
        check_params_are_for("/skin", ["skin_driver", "--ros-args", "--params-file", str(others)])


def test_values_have_the_types_that_ros_reads(tmp_path: Path) -> None:
    path = tmp_path / "types.yaml"
    path.write_text(
        "/**: {ros__parameters: {chip_us: 5e1, frame_period_ms: 20, sign_seed: 0x10, parity: yes,\n"
        "  nodes_repeat: OFF, digitizer_id: '0', mount_xyz_m: [1, -.5, 2.], skin: a b}}"
    )
    assert read_file(path) == {
        "chip_us": 50.0,
        "frame_period_ms": 20.0,
        "sign_seed": 16,
        "parity": True,
        "nodes_repeat": False,
        "digitizer_id": "0",
        "mount_xyz_m": (1.0, -0.5, 2.0),
        "skin": "a b",
    }


def test_the_tables_in_the_documentation_are_up_to_date() -> None:
    command = [sys.executable, str(ROOT / "tools" / "parameter_table.py"), "--check"]
    assert subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}).returncode == 0
