# SPDX-License-Identifier: Apache-2.0

"""What is declared in several places agrees, and the core stays free of ROS and of hardware."""

import ast
import importlib
import os
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import pytest

import tactile_cdma
from tactile_cdma.readings.status import Status
from test.support.programs import run_python

pytestmark = pytest.mark.xdist_group("package")  # its fixture is made once
ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "tactile_cdma"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in PACKAGE.rglob("*.py")
    if path.relative_to(PACKAGE).parts[0] != "ros" and path.name != "__main__.py"
)
OPEN_PORTS = ("calibrate", "cli", "node", "ports", "record", "view")
KNOW_PORTS = ("discovery", "introduction", "port", "virtual_port")
LOAD_SERIAL = {
    *("body", "skin", "live_observation", "doctor.port", "driver.driver", "rest.rest_keeper"),
    *("calibrating.load_session", "replay.protocol_replay", "sim.pressing", "sim.protocol_sim"),
    *(f"commands.{name}" for name in OPEN_PORTS),
    *(f"wire.{name}" for name in KNOW_PORTS),
    *(f"sources.{name}" for name in ("flexitac", "serial_source", "source_digitizer", "text")),
}
"""Modules that open ports. import-linter checks which folder imports which; the test below checks
what it cannot see: that importing any other module loads neither pyserial nor rclpy."""
OTHER_ROS_PACKAGES = {"ament_index_python", "launch", "launch_ros", "rclpy"}
COME_WITH_OTHER_WHEELS = {
    *("ament-index-python", "builtin-interfaces", "lifecycle-msgs", "rcl-interfaces"),
    *("rosidl-default-runtime", "std-msgs"),
}
PACKAGES_OF_KEYS = {
    "python3-cffi": "cffi",
    "python3-numpy": "numpy",
    "python3-packaging": "packaging",
    "python3-serial": "pyserial",
    "python3-yaml": "pyyaml",
}
MODULES_OF_PACKAGES = {"opencv-python-headless": "cv2", "pillow": "PIL", "rerun-sdk": "rerun"}


RUN_ELSEWHERE = sorted(
    path
    for folder in ("launch", "scripts", "examples", "integrations")
    for path in (ROOT / folder).rglob("*")
    if path.suffix == ".py" or (folder == "scripts" and path.is_file() and not path.suffix)
)


@pytest.mark.parametrize("path", RUN_ELSEWHERE, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_is_imported_where_no_test_may_run_it_is_there(path: Path) -> None:
    """Launch files need launch_ros, and examples packages, which are not on every machine."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE.name):
            module = importlib.import_module(node.module or "")
            missing = {alias.name for alias in node.names if not hasattr(module, alias.name)}
            inside = {path.stem for path in Path(module.__file__ or "").parent.iterdir()}
            assert missing <= inside, f"{node.module} has no {missing - inside}"


@pytest.fixture(scope="module")
def package_xml() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def dependencies(package_xml: ElementTree.Element, *kinds: str) -> set[str]:
    return {element.text or "" for element in package_xml if element.tag in {"depend", *kinds}}


def names_of(requirements: list[str]) -> set[str]:
    return {
        match[0].lower()
        for line in requirements
        if (match := re.match(r"[\w-]+", line.split("#")[0]))
    }


def requirements(name: str) -> set[str]:
    return names_of((ROOT / name).read_text().splitlines())


def test_version_is_the_same_everywhere(package_xml: ElementTree.Element) -> None:
    assert package_xml.findtext("version") == tactile_cdma.__version__
    assert "version" in PYPROJECT["project"]["dynamic"]
    dynamic = PYPROJECT["tool"]["setuptools"]["dynamic"]
    assert dynamic["version"]["attr"] == "tactile_cdma.__version__"


def test_requirements_are_known_to_rosdep(package_xml: ElementTree.Element) -> None:
    keys = {key for key in dependencies(package_xml, "exec_depend") if key.startswith("python3-")}
    optional = PYPROJECT["project"]["optional-dependencies"]
    extras = {name: names_of(needed) for name, needed in optional.items()}
    assert {PACKAGES_OF_KEYS[key] for key in keys} == (requirements("requirements.txt"))
    tested = set().union(*(extras[name] for name in ("bags", "calibrate", "learn", "plot")))
    assert tested <= requirements("requirements-dev.txt")


@pytest.mark.parametrize("distro", ["jazzy", "kilted"])
def test_ros_packages_of_package_xml_are_installed_from_pypi(
    package_xml: ElementTree.Element, distro: str
) -> None:
    names = requirements(f"requirements-{distro}.txt") | requirements("requirements-dev.txt")
    wheels = {name.removeprefix(f"ros-{distro}-") for name in names}
    needed = {name.replace("_", "-") for name in dependencies(package_xml, "exec_depend")}
    needed -= PACKAGES_OF_KEYS.keys()
    needed -= {"launch", "launch-ros"}  # not on PyPI: `make run` does without
    needed -= {"tf2-msgs"}  # not on PyPI: tools/tf2_msgs
    needed -= COME_WITH_OTHER_WHEELS
    assert needed <= wheels


def test_every_ros_package_imported_is_a_dependency(package_xml: ElementTree.Element) -> None:
    declared = dependencies(package_xml, "exec_depend")
    for path in [*(ROOT / "tactile_cdma").rglob("*.py"), *(ROOT / "launch").glob("*.py")]:
        imported = re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(), re.MULTILINE)
        ros = {
            name
            for name in imported
            if name.endswith(("_msgs", "_interfaces")) or name in OTHER_ROS_PACKAGES
        }
        assert ros <= declared, path


NEED_RERUN = {"views.rerun_scene"}
"""Modules that need a package of an extra when they are imported."""


def test_core_modules_load_neither_ros_nor_serial() -> None:
    """All of them in one fresh interpreter; the first that does is named."""
    program = (
        "import importlib, sys\n"
        "for module in sys.argv[1:]:\n"
        "    importlib.import_module(module)\n"
        "    assert not {'rclpy', 'serial'} & {*sys.modules}, module\n"
    )
    names = [
        module
        for module in MODULES
        if module.removeprefix("tactile_cdma.") not in LOAD_SERIAL | NEED_RERUN
    ]
    run = run_python("-c", program, *names, cwd=ROOT)
    assert run.returncode == 0, run.stderr


def test_a_driver_works_without_what_extras_bring() -> None:
    """And with none of it loaded; what needs it names the package in one sentence."""
    program = (
        "import importlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    sys.modules[name] = None\n"
        "from tactile_cdma import Skin\n"
        "from tactile_cdma.commands.cli import main\n"
        "if importlib.util.find_spec('rclpy'):\n"
        "    import tactile_cdma.ros.driver.node, tactile_cdma.ros.body.node\n"
        "with Skin('sim://?scene=all&threshold=0', nodes=16, contacts=True) as skin:\n"
        "    assert skin.read().active.all()\n"
        "assert main(['doctor']) == 0\n"
        "assert main(['layout', 'config/layouts/grid.yaml', '--png', 'none/grid.png']) == 1\n"
    )
    extras = set().union(*map(names_of, PYPROJECT["project"]["optional-dependencies"].values()))
    modules = {MODULES_OF_PACKAGES.get(name, name.replace("-", "_")) for name in extras}
    assert {"matplotlib", "pyarrow", "rosbags", "cv2", "PIL"} <= modules
    run = run_python("-c", program, *sorted(modules), cwd=ROOT)
    assert run.returncode == 0, run.stderr
    assert "a picture needs the Python package matplotlib, which is not installed" in run.stderr


def test_status_bits_of_message_and_core_agree() -> None:
    text = (ROOT / "msg" / "TactileArray.msg").read_text()
    constants = re.findall(r"^uint8 STATUS_(\w+)=(\d+)", text, re.MULTILINE)
    assert {name: int(value) for name, value in constants} == {
        name: int(bit) for name, bit in Status.__members__.items()
    }


def test_architecture_names_every_folder_and_each_says_what_it_is_for() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    [section] = re.findall(r"^## Folders\n.*?(?=^## )", page, re.MULTILINE | re.DOTALL)
    listed = re.findall(r"`([\w/]+)/`", section.partition("interface.")[2])
    inits = [init for init in PACKAGE.glob("**/__init__.py") if init.parent != PACKAGE]
    assert sorted(listed) == sorted(i.parent.relative_to(PACKAGE).as_posix() for i in inits)
    silent = [i for i in inits if not ast.get_docstring(ast.parse(i.read_text(encoding="utf-8")))]
    assert silent == []


def test_folders_stay_small_enough_to_look_into() -> None:
    for folder in {path.parent for path in PACKAGE.rglob("*.py")}:
        most = 5 if folder == PACKAGE else 15
        assert len(list(folder.glob("*.py"))) <= most, folder


@pytest.mark.parametrize("folder", [".", "tools/tf2_msgs"])
def test_package_xml_is_valid(folder: str) -> None:
    """By catkin_pkg, which colcon and rosdep read it with; a warning is an error here."""
    package = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed")
    warnings: list[str] = []
    package.parse_package(ROOT / folder, warnings=warnings).validate(warnings=warnings)
    assert warnings == []


COMMENTS = {".py": "#", ".c": "//", ".h": "//", ".cmake": "#"}
NOT_OURS = {"build", "dist", "install", "log", "node_modules"}
NOTICE = "SPDX-License-Identifier: Apache-2.0"


def sources() -> Iterator[Path]:
    """Source files of this repository."""
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [name for name in folders if name[0] not in "._" and name not in NOT_OURS]
        yield from (Path(folder, name) for name in names if Path(name).suffix in COMMENTS)


def test_every_source_file_names_the_licence() -> None:
    missing = []
    for source in sources():
        text = source.read_text(encoding="utf-8")
        first = text.splitlines()[text.startswith("#!") :][:1]
        if text and first != [f"{COMMENTS[source.suffix]} {NOTICE}"]:
            missing.append(source.relative_to(ROOT).as_posix())
    assert missing == []
    licence = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "Apache License" in licence and "Version 2.0" in licence
