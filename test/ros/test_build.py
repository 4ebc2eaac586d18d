# SPDX-License-Identifier: Apache-2.0

"""The package builds as users build it, with colcon in a workspace."""

import os
import shutil
import signal
import sys
from pathlib import Path

import pytest

from test.support.programs import run_program, run_python

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.prefix, "bin")
PATH = f"{BIN}{os.pathsep}{os.environ['PATH']}"  # of colcon, and of cmake where the system has none
IGNORED = shutil.ignore_patterns(".*", "build", "install", "log", "__pycache__", "*.egg-info")


def run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> str:
    done = run_program(*command, cwd=cwd, env=env, timeout=600)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout


def test_colcon_build(tmp_path: Path) -> None:
    colcon = shutil.which("colcon", path=PATH)
    assert colcon is not None, "colcon is missing from the environment"
    source = shutil.copytree(ROOT, tmp_path / "src" / "tactile_cdma", ignore=IGNORED)
    with (source / "kernel" / "options.txt").open("a") as options:
        options.write("\n-O0\n")  # not optimised, which takes four fifths of the time
    # Half a minute of compiling is saved: make setup has built all messages by the same CMakeLists.
    for path in [*(source / "msg").iterdir(), *(source / "srv").iterdir()]:
        if path.name != "TactileSkinInfo.msg":  # whose fields are others' messages, too
            path.unlink()
    build(colcon, tmp_path)
    prefix = tmp_path / "install" / "tactile_cdma"
    share = prefix / "share" / "tactile_cdma"
    for program in ROOT.glob("scripts/*[!y_]"):
        assert os.access(prefix / "lib" / "tactile_cdma" / program.name, os.X_OK)
    for path in [*ROOT.glob("launch/*.py"), *ROOT.glob("config/*.*"), *ROOT.glob("urdf/*")]:
        assert (share / path.relative_to(ROOT)).is_file()
    assert imported_from(tmp_path).resolve().is_relative_to(prefix)


def build(colcon: str, workspace: Path) -> None:
    """Build the package of a workspace for release, and install it.

    make setup does it by links, and with assertions.
    """
    run(
        *(colcon, "--log-base", "log", "build", "--install-base", "install"),
        *("--cmake-args", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={sys.executable}"),
        # C++ is not used here: not optimising it saves half of the time
        *("-DCMAKE_BUILD_TYPE=Release", "-DCMAKE_CXX_FLAGS_RELEASE=-O0 -DNDEBUG"),
        "--no-warn-unused-cli",
        cwd=workspace,
        env={**os.environ, "PATH": PATH, "CMAKE_PREFIX_PATH": os.environ["AMENT_PREFIX_PATH"]},
    )


WRONG_FIELD = """
from rclpy.serialization import serialize_message
from tactile_cdma.msg import TactileArray
message = TactileArray()
message._pressure = "no numbers"
serialize_message(message)
"""


@pytest.mark.skipif(not Path(sys.prefix, "setup.json").exists(), reason="not built by make setup")
def test_the_tests_run_with_the_assertions_of_a_plain_build() -> None:
    done = run_python("-c", WRONG_FIELD)
    assert done.returncode == -signal.SIGABRT and "Assertion" in done.stderr


def imported_from(workspace: Path) -> Path:
    """Use messages and code as a user does; the file that the package was imported from.

    With the workspace sourced, and no checkout on the path: .venv has its own there.
    """
    program = (
        "import os, sys;"
        "sys.path = [path for path in sys.path if not os.path.exists(path + '/package.xml')];"
        "from geometry_msgs.msg import Point32;"
        "from tactile_cdma.msg import TactileSkinInfo;"
        "from rclpy.serialization import deserialize_message, serialize_message;"
        "sent = TactileSkinInfo(area=[1.0, 2.0], normals=[Point32(z=1.0)]);"
        "assert deserialize_message(serialize_message(sent), TactileSkinInfo) == sent;"
        "from tactile_cdma.code.codes import code_book; import tactile_cdma.sim;"
        "print(tactile_cdma.__file__)"
    )
    sourced = f'. "{workspace}/install/local_setup.sh" && exec "$0" -c "$1"'
    # colcon's scripts stumble over a blank in the path of the Python that they were made with
    environment = {**os.environ, "COLCON_PYTHON_EXECUTABLE": os.path.realpath(sys.executable)}
    answer = run("sh", "-c", sourced, sys.executable, program, cwd=workspace, env=environment)
    return Path(answer.strip().splitlines()[-1])
