# SPDX-License-Identifier: Apache-2.0

"""Commands of the pages: every one is understood by what it calls, without being run.

Those of other programs (ros2 bag, rqt, apt, KiCad …) are not looked at: they are not at hand.
"""

from __future__ import annotations

import ast
import contextlib
import io
import re
import shlex
from itertools import pairwise
from pathlib import Path

import pytest

from tactile_cdma.commands.cli import SUBCOMMANDS, make_parser
from tactile_cdma.config.parameters import PARAMETERS

ROOT = Path(__file__).resolve().parents[3]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *ROOT.glob("docs/*.md"),
    *ROOT.glob("firmware/**/README.md"),
]
PROMPT = re.compile(r"^(?:\w*\$ +)?((?:tactile-cdma|make|ros2) .*)")
IN_TEXT = re.compile(r"`((?:tactile-cdma|make) [^`…]+)`")
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
TARGETS = {
    *re.findall(r"^([a-z][a-z-]*):(?!=)", MAKEFILE, re.MULTILINE),
    *(f"bench-{path.stem}" for path in ROOT.glob("benchmarks/*.py")),
    *(f"bench-{path.parent.name}" for path in ROOT.glob("benchmarks/*/__main__.py")),
}
[VARIABLES] = re.findall(r"^VARIABLES = (.*)", MAKEFILE, re.MULTILINE)
SKIN_PARAMETERS = {parameter.name for parameter in PARAMETERS}


def pages() -> str:
    """All pages, with lines joined where a command goes on."""
    texts = (page.read_text(encoding="utf-8") for page in PAGES if "node_modules" not in page.parts)
    return "\n".join(texts).replace("\\\n", " ")


def indented() -> set[str]:
    """Commands of indented lines, without prompts and comments."""
    lines = re.findall(r"^    (.*)", pages(), re.MULTILINE)
    found = (match[1] for line in lines if (match := PROMPT.match(line)))
    return {re.split(r" {2,}#| # ", command)[0].strip(" &") for command in found}


def in_text() -> set[str]:
    """Code within text that begins like a command."""
    return set(IN_TEXT.findall(" ".join(pages().split())))


INDENTED, IN_SENTENCES = sorted(indented()), sorted(in_text())


@pytest.mark.parametrize("command", [c for c in INDENTED if c.startswith("tactile-cdma ")])
def test_the_command_line_takes_it(command: str) -> None:
    words = shlex.split(command)[1:]
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            make_parser().parse_args(words)
        except SystemExit as end:
            pytest.fail(f"{end.code}: {said.getvalue()}")


@pytest.mark.parametrize("command", [c for c in IN_SENTENCES if c.startswith("tactile-cdma ")])
def test_the_command_line_has_the_options(command: str) -> None:
    """In sentences, arguments may be left out."""
    name, *words = shlex.split(command.replace("tactile-cdma -v", "tactile-cdma"))[1:]
    if name == "COMMAND":
        return
    assert name in SUBCOMMANDS
    said = io.StringIO()
    with contextlib.redirect_stdout(said), pytest.raises(SystemExit):
        make_parser().parse_args([name, "--help"])
    known = set(re.findall(r"--[a-z][a-z0-9-]*", said.getvalue()))
    assert {word for word in words if word.startswith("--")} <= known


@pytest.mark.parametrize(
    "command", [c for c in (*INDENTED, *IN_SENTENCES) if c.startswith("make ")]
)
def test_make_has_the_target_and_the_variables(command: str) -> None:
    words = shlex.split(command)[1:]
    assigned = {word.partition("=")[0] for word in words if "=" in word}
    targets = {word for word in words if "=" not in word}
    assert assigned <= set(VARIABLES.split())
    assert targets and targets <= TARGETS


@pytest.mark.parametrize("command", [c for c in INDENTED if c.startswith("ros2 launch ")])
def test_the_launch_file_has_the_arguments(command: str) -> None:
    package, file, *arguments = shlex.split(command)[2:]
    tree = ast.parse((ROOT / "launch" / file).read_text(encoding="utf-8"))
    [table] = [
        statement.value
        for statement in tree.body
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "ARGUMENTS"
    ]
    assert isinstance(table, ast.Dict)
    declared = {ast.literal_eval(key) for key in table.keys if key} | SKIN_PARAMETERS
    assert package == "tactile_cdma"
    assert len(declared) > 5
    assert {argument.partition(":=")[0] for argument in arguments} <= declared


@pytest.mark.parametrize("command", [c for c in INDENTED if "ros2 run tactile_cdma" in c])
def test_the_program_and_its_parameters_are_there(command: str) -> None:
    _, _, _, program, *arguments = shlex.split(command)
    assert (ROOT / "scripts" / program).exists()
    body = (ROOT / "tactile_cdma/ros/body/parameters.py").read_text(encoding="utf-8")
    for option, value in pairwise(arguments):
        if option == "-p":
            name = value.partition(":=")[0]
            assert name in SKIN_PARAMETERS if program == "skin_driver" else f'"{name}"' in body


@pytest.mark.parametrize("command", [c for c in INDENTED if "ros2 param " in c])
def test_the_driver_has_the_parameter(command: str) -> None:
    assert shlex.split(command)[4] in SKIN_PARAMETERS


def test_the_pages_have_commands() -> None:
    """Else a change of their layout would hide them from these tests."""
    assert len(INDENTED) > 60 and len(IN_SENTENCES) > 30
