# SPDX-License-Identifier: Apache-2.0

"""Body files: what they contain, and errors with their line."""

import re
from pathlib import Path

import pytest

from tactile_cdma.base.errors import BodyError
from tactile_cdma.config.body_file import Body, read_body
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig

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
def test_wrong_files_are_refused_with_line_and_reason(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(BodyError, match=re.escape(message)) as refused:
        read(tmp_path, text)
    assert "line " in str(refused.value)


def test_ports_in_parameter_files_count_and_simulations_do_not(tmp_path: Path) -> None:
    (tmp_path / "skin.yaml").write_text("/**: {ros__parameters: {port: /dev/x}}\n")
    with pytest.raises(BodyError, match="'b' has port '/dev/x', and so has 'a'"):
        read(tmp_path, "patches: {a: {params_file: skin.yaml}, b: {params_file: skin.yaml}}")
    simulated = "{parameters: {port: 'sim://?scene=idle'}}"
    assert len(read(tmp_path, f"patches: {{a: {simulated}, b: {simulated}}}").patches) == 2


def test_patches_that_no_tf_mounts_may_share_a_frame(tmp_path: Path) -> None:
    shared = "{parameters: {frame_id: hand}}"
    assert len(read(tmp_path, f"patches: {{a: {shared}, b: {shared}}}").patches) == 2


def test_the_shipped_body_is_one_that_drivers_take() -> None:
    body = read_body(CONFIG / "body.yaml")
    taxels = {patch.name: len(SkinConfig.of(patch.parameters).layout) for patch in body.patches}
    assert taxels == {
        "chest": 64,
        "left_forearm": 72,
        "right_forearm": 72,
        "left_palm": 16,
        "right_elbow": 25,
    }
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


def test_more_processes_than_dds_lets_find_each_other_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
