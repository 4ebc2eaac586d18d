# SPDX-License-Identifier: Apache-2.0

"""Tests stand alone: what several need is in test/support, which nothing that is installed uses.

And test runs beside each other do not hear each other.
"""

import ast
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from test.support.domains import own_domain
from test.support.programs import run_python

ROOT = Path(__file__).resolve().parents[3]
TEST = ROOT / "test"
SUPPORT = TEST / "support"


def imported(path: Path) -> Iterator[str]:
    """Full names of the modules that a file imports from elsewhere than its own folder."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("folder", ["test", "torture", "benchmarks"])
def test_what_tests_share_is_in_test_support(folder: str) -> None:
    own = {path.stem for path in TEST.rglob("*.py")} - {path.stem for path in SUPPORT.glob("*.py")}
    for path in (ROOT / folder).rglob("*.py"):
        for name in imported(path):
            parts = name.split(".")
            assert parts[0] not in own, f"{path} imports {name}, a test's module"
            assert parts[0] != "test" or parts[:2] == ["test", "support"], f"{path}: {name}"


def test_the_package_needs_no_test() -> None:
    for path in (ROOT / "tactile_cdma").rglob("*.py"):
        outside = [name for name in imported(path) if name.split(".")[0] in ("test", "torture")]
        assert not outside, f"{path} imports {outside}"


def test_no_domain_is_given_twice() -> None:
    another = "from test.support.domains import own_domain; print(own_domain())"
    mine = {own_domain(str(key)) for key in range(5)}
    assert len(mine) == 5 and own_domain() == int(os.environ["ROS_DOMAIN_ID"]) not in mine
    for _ in range(3):
        found = run_python("-c", another, check=True).stdout
        assert int(found) not in mine | {own_domain()}
