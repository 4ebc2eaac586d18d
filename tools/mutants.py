#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Mutation testing of a change, `make mutants`: names the wrong operators that pass unnoticed.

Takes random one-operator mutants (and ↔ or, < ↔ <=, + ↔ -, …) of the modules of tactile_cdma that
differ from a revision, or of those that are named, and runs the unit tests on each in a copy of
the checkout: those of the module's folder first, then those of the core. Prints the survivors;
exit code 1 where there are any. A survivor is either a missing test or an operator that makes no
difference.

Why not mutmut or cosmic-ray: mutmut imports its mutants from a folder of its own, which .venv hides
by putting the checkout first in sys.path; cosmic-ray runs all tests on all mutants, which takes
days here.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "tactile_cdma"
PAIRS = (
    (ast.And, ast.Or),
    (ast.Lt, ast.LtE),
    (ast.Gt, ast.GtE),
    (ast.Eq, ast.NotEq),
    (ast.Is, ast.IsNot),
    (ast.In, ast.NotIn),
    (ast.Add, ast.Sub),
    (ast.BitAnd, ast.BitOr),
    (ast.UAdd, ast.USub),
)
SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    **dict(PAIRS),
    **{other: one for one, other in PAIRS},
    **{ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult},
    ast.Invert: ast.UAdd,
}
TIMEOUT_S = 600
"""Tests that a mutant keeps busy for longer, s, have found it: ten times what they need."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", type=Path, help="paths; default: those that changed")
    parser.add_argument("--since", default="HEAD~1", help="changed since this revision")
    parser.add_argument("--count", type=int, default=24, help="mutants to try")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--core", nargs="*", default=[], help="folders of test/unit tried last")
    arguments = parser.parse_args()
    modules = [path.resolve() for path in arguments.modules] or changed(arguments.since)
    mutants = [(path, i) for path in modules for i in range(len(operators(path)))]
    if not mutants:
        print(f"no operator in {len(modules)} changed modules")
        return 0
    chosen = random.Random(arguments.seed).sample(mutants, min(arguments.count, len(mutants)))  # noqa: S311
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        copied = copy_of_checkout(Path(folder))
        for number, (path, i) in enumerate(sorted(chosen), 1):
            line, text = mutate(path, i, copied)
            alive = all(survives(copied, tests) for tests in suites(path, arguments.core))
            shutil.copy(path, copied / path.relative_to(ROOT))
            survivors += alive
            verdict = "SURVIVED" if alive else "killed"
            place = f"{path.relative_to(ROOT)}:{line}"
            print(f"{number:3}/{len(chosen)} {verdict:8} {place} {text}", flush=True)
    print(f"{survivors} of {len(chosen)} mutants survived")
    return int(survivors > 0)


def changed(since: str) -> list[Path]:
    """List modules of the package that differ from a revision."""
    command = ["git", "diff", "--name-only", "--diff-filter=d", since, "--", "tactile_cdma/*.py"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in names.split()]


def operators(path: Path) -> list[tuple[ast.AST, str, int]]:
    """List a module's operators: the node that holds it, the field, the place in a list field."""
    return list(_operators(ast.parse(path.read_text(encoding="utf-8"))))


def _operators(tree: ast.AST) -> Iterator[tuple[ast.AST, str, int]]:
    hints = {id(part) for node in ast.walk(tree) for part in _of_hints(node)}
    for node in ast.walk(tree):
        if id(node) in hints:
            continue
        if isinstance(node, ast.BoolOp | ast.BinOp | ast.AugAssign | ast.UnaryOp):
            if type(node.op) in SWAPS:
                yield node, "op", 0
        elif isinstance(node, ast.Compare):
            yield from ((node, "ops", i) for i, op in enumerate(node.ops) if type(op) in SWAPS)


def _of_hints(node: ast.AST) -> Iterator[ast.AST]:
    """Return all that stands in a type hint, where | is no operator."""
    for field in ("annotation", "returns"):
        if (hint := getattr(node, field, None)) is not None:
            yield from ast.walk(hint)


def mutate(path: Path, index: int, copied: Path) -> tuple[int, str]:
    """Write the module with one other operator; returns its line and what it says now."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    node, field, place = list(_operators(tree))[index]
    if field == "ops":
        assert isinstance(node, ast.Compare)
        node.ops[place] = SWAPS[type(node.ops[place])]()  # type: ignore[call-overload]
    else:
        setattr(node, field, SWAPS[type(getattr(node, field))]())
    target = copied / path.relative_to(ROOT)
    target.write_text(ast.unparse(ast.fix_missing_locations(tree)), encoding="utf-8")
    return getattr(node, "lineno", 0), ast.unparse(node).splitlines()[0]


def copy_of_checkout(folder: Path) -> Path:
    """Copy what git knows of, as it is in the working tree."""
    command = ["git", "ls-files", "-co", "--exclude-standard", "-z"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


def suites(path: Path, core: list[str]) -> Iterator[list[str]]:
    """List folders of tests, in the order in which they are tried."""
    own = path.relative_to(PACKAGE).parts[0]
    if (ROOT / "test" / "unit" / own).is_dir():
        yield [f"test/unit/{own}"]
    if core:
        yield [f"test/unit/{name}" for name in core if name != own]


def survives(copied: Path, tests: list[str]) -> bool:
    """Tell whether these tests pass on the copy."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "2", "--dist", "loadgroup"]
    try:
        run = subprocess.run(
            [*command, "-m", "not slow", "--hypothesis-profile", "quick", *tests],
            cwd=copied,
            capture_output=True,
            timeout=TIMEOUT_S,
            env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        )
    except subprocess.TimeoutExpired:
        return False
    return run.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
