# SPDX-License-Identifier: Apache-2.0

"""docs/architecture.md's tour of a frame is the way that a frame takes."""

import json
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from test.support.boards import plugged
from test.support.traced_frame import COVERAGE

pytestmark = pytest.mark.xdist_group("tour")  # its kernel is built and a frame traced once
CHECKOUT = Path(__file__).parents[2]
PACKAGE, KERNEL = CHECKOUT / "tactile_cdma", CHECKOUT / "kernel"
MOST_FILES = 12, 8
"""Of either half of the tour: from bytes to words, and on to the message."""
_FILE = re.compile(r"`([\w/]+\.(?:py|c))`")
_NAME = re.compile(r"`([A-Za-z_]\w*(?:\.(?!(?:py|c|h)`)\w+)?)`")


def tour() -> str:
    """The section of the tour."""
    text = (CHECKOUT / "docs" / "architecture.md").read_text()
    [section] = re.findall(r"^## The way of one frame.*?(?=^## )", text, re.MULTILINE | re.DOTALL)
    return str(section)


def steps() -> str:
    """Its numbered steps: those of a frame in which nothing is odd."""
    return "".join(re.findall(r"^(?:\d+\.|   ).*\n", tour(), re.MULTILINE))


@pytest.fixture(scope="module")
def passed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """The functions that an ordinary frame calls, by file."""
    compiler, gcov = shutil.which("gcc"), shutil.which("gcov")
    if compiler is None or gcov is None:
        pytest.skip("gcc and gcov count what the kernel executes")
    folder = tmp_path_factory.mktemp("coverage")
    (folder / "count.c").write_text(COVERAGE)
    subprocess.run([sys.executable, KERNEL / "build_kernel.py", folder / "_kernel.c"], check=True)
    subprocess.run(
        [
            compiler, "--coverage", *(KERNEL / "options.txt").read_text().split(), "-O0", "-fPIC",
            "-shared", f"-I{KERNEL}", f"-I{sysconfig.get_paths()['include']}",
            *map(str, KERNEL.glob("*.c")), "_kernel.c", "count.c", "-lm", "-o", "_kernel.so",
        ],
        cwd=folder, check=True,
    )  # fmt: skip
    with plugged(lambda: VirtualDigitizer(SimOptions(scene="all", threshold=0))) as tty:
        traced = subprocess.run(
            [sys.executable, "-m", "test.support.traced_frame", str(folder / "_kernel.so"), tty],
            cwd=CHECKOUT, stdout=subprocess.PIPE, check=True,
        )  # fmt: skip
    functions: dict[str, set[str]] = {}
    for file, name in json.loads(traced.stdout):
        functions.setdefault(file, set()).add(name)
    counted = subprocess.run(
        [gcov, "--json-format", "--stdout", *map(str, folder.glob("*.gcda"))],
        cwd=folder, stdout=subprocess.PIPE, check=True,
    )  # fmt: skip
    for report in map(json.loads, counted.stdout.splitlines()):
        for source in report["files"]:
            path = Path(source["file"])
            if path.parent == KERNEL and path.suffix == ".c":
                called = {
                    function["name"].partition(".")[0]
                    for function in source["functions"]
                    if function["execution_count"]
                }
                if called:
                    functions.setdefault(path.name, set()).update(called)
    return functions


def test_a_frame_passes_the_files_of_the_tour_and_no_others(passed: dict[str, set[str]]) -> None:
    assert set(_FILE.findall(steps())) == set(passed)
    seen: set[str] = set()
    halves = re.split(r"^(?=8\. )", steps(), flags=re.MULTILINE)
    for half, most in zip(halves, MOST_FILES, strict=True):
        files = set(_FILE.findall(half)) - seen
        assert len(files) <= most
        seen |= files


def test_a_frame_calls_the_functions_of_the_tour(passed: dict[str, set[str]]) -> None:
    called = set().union(*passed.values())
    named = set(_NAME.findall(steps())) - {"TactileFrame", "LineFrame"}
    assert len(named) > 20
    assert named <= called


def test_what_else_the_tour_names_is_there() -> None:
    sources = [*PACKAGE.rglob("*.py"), *KERNEL.glob("*.[ch]")]
    text = "\n".join(path.read_text() for path in sources)
    files = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py")}
    files |= {path.name for path in KERNEL.glob("*")}
    files |= {"test/ros/test_tour.py", "crc32.c"}
    assert set(_FILE.findall(tour())) <= files
    for name in set(_NAME.findall(tour())) - {"zlib"}:
        owner, _, method = name.rpartition(".")
        assert re.search(rf"\b{method}\b", text), name
        assert not owner or re.search(rf"class {owner}\b", text), name


def test_what_comments_in_c_name_of_python_is_there() -> None:
    texts: dict[str, str] = {}
    for path in PACKAGE.rglob("*.py"):
        texts[path.name] = texts.get(path.name, "") + path.read_text()
    kernel = "".join(path.read_text() for path in KERNEL.glob("*.[ch]"))
    named: set[tuple[str, str]] = set()
    for comment in re.findall(r"/\*.*?\*/", kernel, re.DOTALL):
        flat = re.sub(r"\n \* ", " ", comment)
        named |= set(re.findall(r"\b(?!as |does )(\w+)`? in (?:\w+/)*(\w+\.py)", flat))
        named |= {(name, "") for name in re.findall(r"\b[A-Z]\w+\.(?!py\b)[a-z_]\w+", flat)}
    assert len(named) > 8  # the comments are found
    for name, file in named:
        owner, _, method = name.rpartition(".")
        text = texts.get(file) or "".join(texts.values())
        made = rf"\b(?:def|class) {method}\b|^ *{method}\b.*[:=]"
        assert re.search(made, text, re.MULTILINE), name
        assert not owner or re.search(rf"class {owner}\b", text), name
