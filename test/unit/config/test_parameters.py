# SPDX-License-Identifier: Apache-2.0

"""The parameter table, parameter and body files, the configuration made of them, and rates."""

import logging
import os
import re
import subprocess
import sys
from array import array
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tactile_cdma.base.errors import BodyError, ParameterError, SpecError
from tactile_cdma.config.arguments import check_params_are_for, launch_values
from tactile_cdma.config.body_file import Body, read_body
from tactile_cdma.config.frame_rate import MCU_OF
from tactile_cdma.config.parameters import (
    ANY,
    BY_NAME,
    FOUR,
    KINDS,
    PARAMETERS,
    SIMULATION,
    Value,
    check_values,
    read_file,
)
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.driver.session import Session
from tactile_cdma.hardware.node_memory import node_memory, read_node_memory
from tactile_cdma.recording.offline import parameters_of
from tactile_cdma.wire.messages import FrameLayout, Info
from tactile_cdma.wire.packets import PacketParser
from test.support.calibrations import write_calibration
from test.support.examples import examples
from test.support.simulated import stream

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
        ({"roll_call": "true"}, "roll_call is gone: nodes keep time by the sync line"),
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


def test_shipped_files_and_defaults_are_sound_and_scrambled_but_the_papers() -> None:
    assert BY_NAME["port"].default == ""
    for path in (ROOT / "config").glob("*skin.yaml"):
        assert not str(read_file(path).get("port", "")).startswith(SIMULATION)
    files = [path for path in (ROOT / "config").glob("*.yaml") if "body" not in path.name]
    specs = {path.name: SkinConfig.of(read_file(path)).spec for path in files}
    assert {name for name, spec in specs.items() if not spec.scramble} == {"paper_skin.yaml"}
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
        ({"digitizer_id": "E6", "calibration_file": "/nowhere.yaml"}, "digitizer_id is 'E6'"),
        ({"nodes": "16"}, "nodes must be an integer, got '16'"),
        ({"nodes": True}, "nodes must be an integer"),
        ({"bits": 10.0}, "bits must be an integer"),
        ({"parity": 2}, "parity must be true or false, got 2"),
        ({"chip_us": -1.0}, "chip_us is -1 µs; it must lie within 0.01…1e.06 µs"),
        ({"chip_us": float("nan")}, "chip_us is nan"),
        ({"drive": "uni"}, "drive is 'uni'; it must be one of bipolar, unipolar"),
        ({"node_kind": "huge"}, "node_kind is 'huge'; it must be one of"),
        ({"rate_hz": -1.0}, "rate_hz is -1 Hz; it must lie within"),
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
        (
            {"nodes": 900, "rate_hz": 50.0, "node_kind": "slow"},
            r"no slow .* faster than 3\.1 Hz, with chips of 35 µs",
        ),
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


def test_integers_are_numbers_and_some_mean_something_else() -> None:
    assert check_values({"chip_us": 50}) == {"chip_us": 50.0}
    for three in ([1, 2.5, 3], (1.0, 2.5, 3.0), array("d", [1, 2.5, 3])):
        assert check_values({"mount_xyz_m": three}) == {"mount_xyz_m": (1.0, 2.5, 3.0)}
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
    ("section", "fits"),
    [
        ("/**", True),
        ("/**/skin", True),
        ("/**/**/skin/**", True),
        ("/*/*/skin", True),
        ("/left/palm/skin", True),
        ("/left/**/palm/*", True),
        ("/**/left/palm/skin", True),
        ("/*/skin", False),
        ("/**/palm", False),
        ("/left/palm/skin/*", False),
        ("/right/**", False),
        ("/**/left", False),
        ("/left", False),
    ],
)
def test_wildcards_stand_for_parts_of_names(tmp_path: Path, section: str, fits: bool) -> None:
    path = tmp_path / "skin.yaml"
    path.write_text(f"'{section}': {{ros__parameters: {{bits: 10}}}}")
    if fits:
        assert read_file(path, "/left/palm/skin") == {"bits": 10}
    else:
        with pytest.raises(ParameterError, match="this node is /left/palm/skin: write /left/palm"):
            read_file(path, "/left/palm/skin")


def test_of_sections_the_last_counts_and_of_files_one_is_for_the_node(tmp_path: Path) -> None:
    path = tmp_path / "names.yaml"
    path.write_text("skin: {ros__parameters: {bits: 12}}\n/**: {ros__parameters: {bits: 11}}\n")
    assert read_file(path, "/skin") == {"bits": 11}
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


@given(
    nodes=st.integers(1, 1200),
    rate_hz=st.floats(0.5, 400),
    kind=st.sampled_from([ANY, *KINDS, FOUR]),
    scramble=st.booleans(),
    parity=st.booleans(),
)
@examples(80)
def test_nodes_of_the_kind_take_what_is_chosen_and_it_has_the_rate(
    nodes: int, rate_hz: float, kind: str, scramble: bool, parity: bool
) -> None:
    """Each memory's own checks, which know nothing of rates, are the judge; or the refusal is."""
    assume(nodes > 2)  # scrambled codes are longer
    asked = {"nodes": nodes, "node_kind": kind, "scramble": scramble, "parity": parity}
    try:
        config = SkinConfig.of({**asked, "rate_hz": rate_hz})  # type: ignore[dict-item]
    except SpecError as error:
        assert str(error).startswith(f"rate_hz is {rate_hz:g}: no ")
        if found := re.search(r"faster than ([\d.]+) Hz", str(error)):
            fastest_hz = float(found[1])
            assert fastest_hz <= rate_hz
            if fastest_hz:
                SkinConfig.of({**asked, "rate_hz": fastest_hz})  # type: ignore[dict-item]
        else:
            assert kind in ("tiny", FOUR) and nodes >= 1000  # its memory holds no longer row
        return
    period_s = config.spec.frame_period_s
    assert 1 / rate_hz - 1e-6 <= period_s <= 1 / rate_hz
    assert config.node_kind == kind or kind == ANY
    memory = node_memory(config.spec, nodes, mcu=MCU_OF[config.node_kind], heartbeat=1)
    record, _ = read_node_memory(memory)
    assert record.frame_period_us == round(period_s * 1e6)
    assert record.chip_ns >= 2000  # a converter of 500 kS/s


def test_tiny_nodes_on_the_data_wire_have_an_image_of_their_own() -> None:
    asked: dict[str, Value] = {"nodes": 4, "rate_hz": 40.0, "node_kind": "tiny"}
    for wire, image in (("own", "attiny85"), ("data", "attiny85-data")):
        choice = SkinConfig.of({**asked, "sync_wire": wire}).choice
        assert choice.endswith(f"({image})")


@pytest.mark.parametrize(
    ("values", "chip_us", "kind"),
    [
        ({"nodes": 16}, 50.0, "slow"),
        ({"nodes": 40}, 43.1, "slow"),
        ({"nodes": 16, "node_kind": "fast"}, 16.0, "fast"),
        ({"nodes": 36, "node_kind": "four"}, 45.5, "four"),
        ({"nodes": 900, "scramble": True}, 2.0, "fast"),
    ],
)
def test_host_digitizer_and_recording_agree_on_what_was_chosen(
    values: dict[str, object], chip_us: float, kind: str
) -> None:
    """The simulated digitizer is set to it, describes it, and its frames are read at that rate."""
    config = SkinConfig.of({**values, "rate_hz": 50.0})  # type: ignore[dict-item]
    assert config.spec.chip_s * 1e6 == pytest.approx(chip_us)
    assert f"rate_hz 50: chip_us {chip_us}, frame_period_ms 20.0" in config.choice
    assert "write these anew" not in config.choice and config.node_kind == kind
    pipeline = Pipeline(config)
    data = stream(config, "sim://?scene=all&threshold=0", 5)
    frames = pipeline.feed(data, 0.0)
    assert len(frames) >= 4 and all(frame.words.active.all() for frame in frames)
    times_s = [frame.t_middle for frame in frames]
    assert times_s[-1] - times_s[0] == pytest.approx(0.02 * (len(frames) - 1), rel=1e-3)
    [*_, info] = [p for p in PacketParser().feed(data) if isinstance(p, Info)]
    described = SkinConfig.of({**values, "rate_hz": 77.0, **parameters_of(info)})  # type: ignore[dict-item]
    layouts = [FrameLayout.of(each.spec, each.samples_per_chip) for each in (described, config)]
    assert layouts[0] == layouts[1]
    Session(config)


def test_on_hardware_it_says_what_to_write_anew() -> None:
    said = SkinConfig.of({"rate_hz": 100.0, "port": "/dev/ttyACM0"}).choice
    assert "nodes with other records: write these anew (tactile-cdma node --all)" in said


def test_a_frame_of_half_a_second_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    config = SkinConfig.of({"nodes": 900})
    [text] = [r.message for r in caplog.records if r.levelno == logging.WARNING]
    named = float(text.split("chip_us ")[1].split()[0])
    assert config.spec.frame_s > 0.4
    faster = SkinConfig.of({"nodes": 900, "chip_us": named, "frame_period_ms": 0.0})
    assert 0.0199 < faster.spec.frame_period_s <= 0.02
    caplog.clear()
    SkinConfig.of({"nodes": 90})
    SkinConfig.of({"nodes": 900, "rate_hz": 2.0})
    assert not [r for r in caplog.records if r.levelno == logging.WARNING]


def test_chips_of_the_parameter_count_unless_a_rate_is_asked_for() -> None:
    assert SkinConfig.of({"chip_us": 37.0}).spec.chip_s == pytest.approx(37e-6)


CONFIG = Path(__file__).resolve().parents[3] / "config"


def read(tmp_path: Path, text: str) -> Body:
    path = tmp_path / "body.yaml"
    path.write_text(text)
    return read_body(path)


def test_a_patch_takes_what_its_file_and_its_parameters_say(tmp_path: Path) -> None:
    (tmp_path / "skin.yaml").write_text("/**: {ros__parameters: {port: /dev/ttyACM3}}\n")
    body = read(
        tmp_path,
        """\
        frame_id: torso
        patches:
          palm:
            params_file: skin.yaml
            parameters:
              nodes: 20
              frame_period_ms: 20
              nodes_repeat: true
              skin: 7
              parity: yes
              mount_xyz_m: [1, 2.5, -3]
          back: {}
        """,
    )
    assert body.frame_id == "torso"
    palm, back = body.patches
    assert (palm.name, palm.node) == ("palm", "/palm/skin")
    assert palm.params_file == tmp_path / "skin.yaml"
    assert palm.parameters == {
        "frame_id": "palm",
        "nodes": 20,
        "frame_period_ms": 20.0,
        "nodes_repeat": True,
        "skin": "7",
        "parity": True,
        "mount_xyz_m": (1.0, 2.5, -3.0),
        "parent_frame": "torso",  # it has a mount, and no parent_frame was given
    }
    assert type(palm.parameters["frame_period_ms"]) is float
    assert (back.params_file, back.parameters) == (None, {"frame_id": "back"})


ROBOT = """
frame_id: torso
stale_after_s: 0.25
patches:
  palm: {parameters: {mount_xyz_m: [0, 0, 0]}}
  tip: {params_file: tip.yaml}
  back: {}
"""


@pytest.mark.parametrize(
    ("namespace", "more", "prefix"),
    [
        ("/r1", "", "r1/"),
        ("lab/r1/", "", "lab/r1/"),
        ("/", "", ""),
        ("/r1", "frame_prefix: left_\n", "left_"),
        ("/r1", "frame_prefix: ''\n", ""),
        ("", "frame_prefix: left_\n", "left_"),
    ],
)
def test_robots_that_share_a_file_have_nodes_and_frames_of_their_own(
    tmp_path: Path, namespace: str, more: str, prefix: str
) -> None:
    within = f"/{namespace.strip('/')}".rstrip("/")
    tip = f"{within}/tip/skin: {{ros__parameters: {{parent_frame: finger, nodes: 4}}}}"
    (tmp_path / "tip.yaml").write_text(tip)
    (tmp_path / "body.yaml").write_text(more + ROBOT)
    body = read_body(tmp_path / "body.yaml", namespace)
    assert (body.frame_id, body.stale_after_s) == (f"{prefix}torso", 0.25)
    nodes = [patch.node for patch in body.patches]
    assert nodes == [f"{within}/{name}/skin" for name in ("palm", "tip", "back")]
    frames = [(p.values["frame_id"], p.values.get("parent_frame")) for p in body.patches]
    parents = f"{prefix}torso", f"{prefix}finger", None
    assert frames == [
        (f"{prefix}{name}", parent)
        for name, parent in zip(("palm", "tip", "back"), parents, strict=True)
    ]
    given = body.patches[1].parameters
    assert given.get("parent_frame") == (f"{prefix}finger" if prefix else None), "over its file"


def test_paths_are_relative_to_the_folder_of_the_body_file(tmp_path: Path) -> None:
    (patch,) = read(
        tmp_path,
        "patches: {a: {parameters: {layout_file: x/y.yaml, calibration_file: /c.yaml, "
        'state_folder: ""}}}',
    ).patches
    assert patch.parameters["layout_file"] == str(tmp_path / "x" / "y.yaml")
    assert patch.parameters["calibration_file"] == "/c.yaml"
    assert patch.parameters["state_folder"] == ""


def test_patches_can_be_selected_by_name(tmp_path: Path) -> None:
    body = read(tmp_path, "patches: {a: {}, b: {}, c: {}}")
    assert [patch.name for patch in body.only("c, a")] == ["a", "c"]
    assert body.only("") == body.patches
    with pytest.raises(BodyError, match=r"no patch 'd' to start; there are a, b, c"):
        body.only("a,d")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame_id: body", "line 1: the body has no 'patches'"),
        ("patches: {}", "line 1: patches has 0 entries"),
        ("patches:\n  a: {}\n  a: {}", "line 3: 'a' again; it stands in line 2"),
        ("patches:\n  a: {}\npatchs: 1", "line 3: unknown key 'patchs' in the body; did you mean"),
        ("patches:\n  a:\n    port: x", "line 3: unknown key 'port' in patch 'a'; known: params"),
        ("patches:\n  left/a: {}", "line 2: patch 'left/a': its name becomes a namespace"),
        ("patches:\n  1st: {}", "line 2: patch '1st': its name"),
        ("patches:\n  a:\n", "line 2: patch 'a' is empty; it must be keys with values"),
        ("frame_id: /body\npatches: {a: {}}", "line 1: frame_id is '/body'"),
        ("patches:\n  a: {parameters: {nods: 3}}", "line 2: unknown parameter 'nods'; did you"),
        ("patches:\n  a: {parameters: {nodes: 0}}", "line 2: nodes is 0; it must lie within"),
        ("patches:\n  a: {parameters: {chip_us: .nan}}", "chip_us must be a number, got '.nan'"),
        ("patches:\n  a: {parameters: {parity: 'on'}}", "parity must be true or false, got 'on'"),
        ("patches:\n  a: {parameters: {skin: }}", "line 2: skin must be a text, got None"),
        ("patches:\n  a: {parameters: {port: [1]}}", "port must be a text, got [1]"),
        ("patches:\n  a: {parameters: {mount_xyz_m: [1, 2]}}", "line 2: mount_xyz_m is [1, 2]"),
        ("patches:\n  a: {params_file: none.yaml}", ": no parameter file "),
        (
            "patches:\n  a: {parameters: {port: /dev/x}}\n  b: {parameters: {port: /dev/x}}",
            "line 3: patch 'b' has port '/dev/x', and so has 'a'",
        ),
        (
            "patches:\n  a: {}\n  b: {parameters: {digitizer_id: 'E6'}}",
            "line 3: patch 'b': digitizer_id is 'E6'; it must be 16 hexadecimal digits",
        ),
        (
            "patches:\n  a: {parameters: {digitizer_id: E66058388372A432}}\n"
            "  b: {parameters: {digitizer_id: 'e6 60 58 38 83 72 a4 32'}}",
            "line 3: patch 'b' has digitizer_id 'E66058388372A432', and so has 'a'",
        ),
        (
            "patches:\n  a: {parameters: {skin: s}}\n  b: {parameters: {skin: s}}",
            "line 3: patch 'b' has skin 's', and so has 'a'",
        ),
        (
            "patches:\n  a: {parameters: {mount_xyz_m: [0, 0, 1]}}\n"
            "  b: {parameters: {frame_id: a, parent_frame: hand}}",
            "line 3: patch 'b' has frame_id 'a', and so has 'a'",
        ),
        ("process: two\npatches: {a: {}}", "process is 'two'; it must be one, per_patch, or"),
        ("process: {p: [a, b]}\npatches: {a: {}}", "process 'p': 'b' is no patch"),
        ("process: {p: [a], q: [a]}\npatches: {a: {}}", "process 'q': 'a' is in two processes"),
        ("patches: {a: {repeat: [x, y]}}", "patch 'a' is repeated: its name must have {}"),
        ("patches: {'a{}': {repeat: [1, 1]}}", "repeat has an item twice"),
        ("patches: {'a{}': {repeat: [1]}, a1: {}}", "repeat makes another patch 'a1'"),
        ("patches: {'a{}': {repeat: no}}", "repeat is 'no'; it must be a list"),
        ("patches: {'a{}': {repeat: []}}", "repeat has 0 entries; it must have 1…"),
        ("patches: {'a{}': {repeat: {b: {nods: 1}}}}", "nods"),
        ("defaults: {port: sim://}\npatches: {a: {}}", "unknown key 'port' in defaults"),
        ("defaults: 5\npatches: {a: {}}", "defaults is '5'; it must be keys with values"),
    ],
)
def test_wrong_files_are_refused_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(BodyError, match=re.escape(message)) as refused:
        read(tmp_path, text)
    assert "line " in str(refused.value)


def test_what_patches_may_and_may_not_share(tmp_path: Path) -> None:
    (tmp_path / "skin.yaml").write_text("/**: {ros__parameters: {port: /dev/x}}\n")
    with pytest.raises(BodyError, match="'b' has port '/dev/x', and so has 'a'"):
        read(tmp_path, "patches: {a: {params_file: skin.yaml}, b: {params_file: skin.yaml}}")
    simulated = "{parameters: {port: 'sim://?scene=idle'}}"
    assert len(read(tmp_path, f"patches: {{a: {simulated}, b: {simulated}}}").patches) == 2
    shared = "{parameters: {frame_id: hand}}"
    assert len(read(tmp_path, f"patches: {{a: {shared}, b: {shared}}}").patches) == 2


def test_the_shipped_body_is_one_that_drivers_take() -> None:
    body = read_body(CONFIG / "body.yaml")
    taxels = {patch.name: len(SkinConfig.of(patch.parameters).layout) for patch in body.patches}
    assert " ".join(taxels) == "chest left_forearm right_forearm left_palm right_elbow"
    assert [*taxels.values()] == [64, 72, 72, 16, 25]
    assert {patch.parameters["parent_frame"] for patch in body.patches} == {body.frame_id}
    for patch in body.patches:
        shared = read_file(patch.params_file) if patch.params_file else {}
        assert SkinConfig.of({**shared, **patch.parameters}).spec.scramble


def test_defaults_and_repeats_write_out_what_patches_have_in_common(tmp_path: Path) -> None:
    body = read(
        tmp_path,
        """
process: {hand: [ff_tip, mf_tip], arm: [palm]}
defaults: {parameters: {nodes: 24, frame_period_ms: 16.0}}
patches:
  "{}_tip":
    repeat: [ff, mf]
    parameters: {port: "SIM://?layout=tip.yaml&seed=3", parent_frame: "{}distal"}
  "{}_mid":
    repeat: {ff: {port: usb://E1}, mf: {port: "replay://a b.skin?loop=1", nodes: 16}}
  palm:
""",
    )
    found = {patch.name: patch.values for patch in body.patches}
    assert list(found) == ["ff_tip", "mf_tip", "ff_mid", "mf_mid", "palm"]
    assert found["mf_tip"]["parent_frame"] == "mfdistal"
    assert found["ff_tip"]["port"] == f"SIM://?layout={tmp_path}/tip.yaml&seed=3"
    assert found["mf_mid"]["port"] == f"replay://{tmp_path}/a%20b.skin?loop=1"
    assert [values["nodes"] for values in found.values()] == [24, 24, 24, 16, 24]
    groups = [[patch.name for patch in group] for group in body.processes()]
    assert groups == [["ff_tip", "mf_tip"], ["palm"], ["ff_mid"], ["mf_mid"]]
    groups = [[patch.name for patch in group] for group in body.processes("mf_tip,mf_mid")]
    assert groups == [["mf_tip"], ["mf_mid"]]


def test_an_item_stands_in_the_texts_of_defaults_and_in_its_own(tmp_path: Path) -> None:
    for item in "ff", "mf":
        (tmp_path / f"{item}.yaml").write_text(f"/**: {{ros__parameters: {{skin: of {item}}}}}")
    body = read(
        tmp_path,
        """
defaults: {params_file: "{}.yaml", parameters: {parent_frame: "{}distal"}}
patches: {"{}_tip": {repeat: {ff: {skin: "{}1"}, mf: {}}}}
""",
    )
    found = {patch.name: patch.values for patch in body.patches}
    assert [values["parent_frame"] for values in found.values()] == ["ffdistal", "mfdistal"]
    assert [values["skin"] for values in found.values()] == ["ff1", "of mf"]


def test_more_processes_than_dds_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By hand, Fast DDS on LOCALHOST: of 90 participants a late one finds 32, of 110 none."""

    def processes(patches: int, process: str, reach: str) -> int:
        text = f"process: {process}\npatches: {{'p{{}}': {{repeat: {[*range(patches)]}}}}}"
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", reach)
        return len(read(tmp_path, text).processes())

    assert processes(110, "one", "LOCALHOST") == 1
    assert [processes(28, "per_patch", "localhost"), processes(90, "per_patch", "")] == [28, 90]
    with pytest.raises(BodyError, match=r"110 processes .* no more than 90 .* find all"):
        processes(110, "per_patch", "SUBNET")
    with pytest.raises(BodyError, match=r"29 processes .* 28 .*=LOCALHOST: .* process: one"):
        processes(29, "per_patch", "LOCALHOST")
