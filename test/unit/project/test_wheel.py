# SPDX-License-Identifier: Apache-2.0

"""A wheel says what it serves, holds what documents name, and works where there is no checkout."""

import importlib.util
import os
import re
import shutil
import sys
import zipfile
from pathlib import Path

import pytest

from test.support.programs import run_program, run_python

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wheel")]  # it is built once
ROOT = Path(__file__).resolve().parents[3]
FOLDERS = "config", "examples", "msg", "urdf"
USES = """
import sys, zipfile
from pathlib import Path
from tactile_cdma.base.named_file import CHECKOUT, shipped
from tactile_cdma.commands.cli import main
from tactile_cdma.messages.types import message_types

assert CHECKOUT == Path(sys.argv[1]), CHECKOUT
assert main(["examples"]) == 0
assert main(["layout", "config/layouts/cylinder.yaml"]) == 0
assert "tactile_cdma/msg/TactileArray" in message_types().fielddefs
assert main(["view"]) == 1, "there is no terminal"
assert main(["doctor", "sim://", "--seconds", "1"]) == 0
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `pip wheel` makes of the sdist, by the setuptools and cffi that are here.

    Its kernel is not optimised, which takes four fifths of the time.
    """
    folder = tmp_path_factory.mktemp("wheel")
    if not (ROOT / ".git").exists():
        pytest.skip("no repository: what belongs to a release is not known")
    source = folder / "source"
    for name in run_program("git", "ls-files", cwd=ROOT, check=True).stdout.split():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    with (source / "kernel" / "options.txt").open("a") as options:
        options.write("\n-O0\n")
    build = "from setuptools import build_meta; import sys; build_meta.build_sdist(sys.argv[1])"
    run_python("-c", build, folder, cwd=source, check=True)
    [sdist] = folder.glob("*.tar.gz")
    made = run_python(
        *("-m", "pip", "wheel", "-q", "--no-index", "--no-deps", "--no-build-isolation"),
        *("-w", folder, sdist),
    )
    assert made.returncode == 0, made.stderr
    [path] = folder.glob("*.whl")
    return path


def test_its_name_says_every_python_from_3_11_on_and_its_module_too(wheel: Path) -> None:
    assert "-cp311-abi3-" in wheel.name
    modules = [name for name in zipfile.ZipFile(wheel).namelist() if "_kernel" in name]
    assert modules == ["tactile_cdma/_kernel.abi3.so"]


def test_it_holds_all_tracked_files_that_documents_name(wheel: Path) -> None:
    tracked = run_program("git", "ls-files", *FOLDERS, cwd=ROOT, check=True).stdout.split()
    held = zipfile.ZipFile(wheel).namelist()
    assert {f"tactile_cdma/share/{name}" for name in tracked} <= {*held}
    assert not [name for name in held if "__pycache__" in name or name.endswith(".pyc")]


def test_the_kernel_calls_nothing_of_python_that_takes_formats(wheel: Path, tmp_path: Path) -> None:
    """What formats are is decided by macros of the Python that builds."""
    if shutil.which("nm") is None:
        pytest.skip("nm (apt: binutils) lists what the kernel wants")
    zipfile.ZipFile(wheel).extract("tactile_cdma/_kernel.abi3.so", tmp_path)
    told = run_program("nm", "-D", "--undefined-only", tmp_path / "tactile_cdma/_kernel.abi3.so")
    wanted = {*re.findall(r"\bU (_?Py\w+)", told.stdout)}
    assert "PyEval_SaveThread" in wanted
    assert not {name for name in wanted if re.search("BuildValue|ParseTuple|CallFunction", name)}


def test_pip_installs_it_with_its_command_where_there_is_no_ros(
    wheel: Path, tmp_path: Path
) -> None:
    """Without a network: what the core imports is this environment's."""
    venv, version = tmp_path / "venv", f"python{sys.version_info[0]}.{sys.version_info[1]}"
    target = venv / "lib" / version / "site-packages"
    assert run_python("-m", "venv", "--without-pip", venv).returncode == 0
    pip = ("-m", "pip", "--python", venv / "bin" / "python", "install", "--no-deps", "-q", wheel)
    made = run_python(*pip)
    assert made.returncode == 0, made.stderr
    for module in ("numpy", "serial", "yaml", "_cffi_backend"):
        spec = importlib.util.find_spec(module)
        assert spec is not None and spec.origin is not None
        found = Path(spec.origin)
        if found.parent.name == module:
            found = found.parent
        for path in [found, *found.parent.glob(f"{module}.libs")]:
            (target / path.name).symlink_to(path)
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "LD_LIBRARY_PATH")}
    told = run_program(venv / "bin" / "tactile-cdma", "--help", cwd=tmp_path, env=clean)
    assert "simulate" in told.stdout, told.stderr
    probe = "import tactile_cdma.sim, tactile_cdma.commands.cli; print(tactile_cdma.__file__)"
    told = run_program(venv / "bin" / "python", "-c", probe, cwd=tmp_path, env=clean)
    assert Path(told.stdout.strip()).is_relative_to(target), told.stderr


def test_it_works_without_a_checkout(wheel: Path, tmp_path: Path) -> None:
    target, empty = tmp_path / "installed", tmp_path / "empty"
    empty.mkdir()
    zipfile.ZipFile(wheel).extractall(target)
    program = f"import sys; sys.path.insert(0, {str(target)!r})\n{USES}"
    run = run_python("-c", program, target, cwd=empty)
    assert run.returncode == 0, run.stderr
