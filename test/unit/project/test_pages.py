# SPDX-License-Identifier: Apache-2.0

"""Pages: links, pictures, sizes, words of the glossary, commands."""

from __future__ import annotations

import ast
import contextlib
import io
import keyword
import re
import shlex
import textwrap
import tokenize
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from tactile_cdma.commands.cli import SUBCOMMANDS, make_parser
from tactile_cdma.config.parameters import PARAMETERS
from test.support.page_blocks import ROOT, blocks
from test.support.programs import run_python

MOST_WORDS, MOST_PAGES, MOST_LINES = 28_000, 21, 110
"""Words of README and docs/*.md, marks of tables included; these pages; lines of README. Chosen:
what one reads in two hours, and a screen or two."""
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted(ROOT.glob("docs/*.md")),
    ROOT / "firmware" / "codes.md",
    ROOT / "firmware" / "first_strip.md",
    *(
        page
        for page in sorted(ROOT.glob("firmware/**/README.md"))
        if "node_modules" not in page.parts
    ),
]
Record = Callable[[str, object], None]
LINK = re.compile(r"\]\(([^)\s#]*)(?:#([^)\s]*))?\)")
FOLDERS = [
    folder.name
    for root in (ROOT, ROOT / "tactile_cdma")
    for folder in root.iterdir()
    if folder.is_dir() and folder.name[0] not in "._"
]
"""Folders of the project and of the package."""
MADE = re.compile(r"firmware/build/|build/")
"""Files that a command makes."""
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors that a forge makes of the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", text.lower()).strip().replace(" ", "-") for text in headings}


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_somewhere(page: Path, record_property: Record) -> None:
    broken = []
    for target, anchor in LINK.findall(CODE.sub("", page.read_text(encoding="utf-8"))):
        if target.startswith(("http:", "https:", "mailto:")):
            continue
        there = (page.parent / target).resolve() if target else page
        if not there.exists() or (anchor and anchor not in anchors(there)):
            broken.append(f"{target}#{anchor}")
    record_property("false_links", len(broken))
    assert broken == []


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent.name != "firmware"])
def test_every_file_that_is_named_exists(page: Path, record_property: Record) -> None:
    """Those of the project, with a folder: others are the reader's."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    if page.name == "CHANGELOG.md":
        text = text.partition("## 0.1.0")[0]
    named = set(re.findall(rf"`({'|'.join(FOLDERS)})/([\w./-]+\.\w+)`", text))
    missing = [
        f"{folder}/{name}"
        for folder, name in named
        if not any((root / folder / name).exists() for root in (ROOT, ROOT / "tactile_cdma"))
        and not MADE.match(f"{folder}/{name}")
    ]
    record_property("false_links", len(missing))
    assert missing == []


def test_the_readme_lists_every_document() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    missing = [page.name for page in ROOT.glob("docs/*.md") if f"(docs/{page.name}" not in text]
    assert missing == []


def test_every_example_says_how_to_run_it_and_a_page_lists_it() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    examples = sorted(ROOT.glob("examples/*.py"))
    assert examples
    for example in examples:
        about = ast.get_docstring(ast.parse(example.read_text(encoding="utf-8"))) or ""
        assert f"examples/{example.name}" in about, f"{example.name}: how is it run?"
        assert f"(../examples/{example.name})" in pages, f"{example.name} is on no page"


def test_the_program_of_the_calibration_page_writes_the_loads_of_its_scene(tmp_path: Path) -> None:
    """The staircase that the page describes: 2 s at each load, 5 kPa apart."""
    page = (ROOT / "docs" / "pressure.md").read_text(encoding="utf-8")
    program = re.search(r"^    # loads\.py\n(?:    .*\n|\n)+", page, re.MULTILINE)
    assert program is not None
    (tmp_path / "loads.py").write_text(textwrap.dedent(program[0]))
    done = run_python(tmp_path / "loads.py")
    heading, *lines = done.stdout.splitlines()
    assert (heading, len(lines), done.stderr) == ("time_s,pressure_kpa", 4000, "")
    loads = dict(line.split(",") for line in lines)
    assert [loads[t] for t in ("1.00", "3.00", "5.00")] == ["0.000", "5.000", "10.000"]


def test_every_picture_is_on_a_page() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    pictures = sorted(ROOT.glob("docs/img/*"))
    assert pictures
    assert [picture.name for picture in pictures if f"img/{picture.name})" not in pages] == []


def test_there_is_not_more_to_read_than_one_can(record_property: Record) -> None:
    pages = [ROOT / "README.md", *ROOT.glob("docs/*.md")]
    texts = [page.read_text(encoding="utf-8") for page in pages]
    words = sum(len(text.split()) for text in texts)
    record_property("pages", len(pages))
    record_property("words", words)
    assert len(texts[0].splitlines()) <= MOST_LINES
    assert len(pages) <= MOST_PAGES
    assert words <= MOST_WORDS


def docstrings(module: ast.Module) -> Iterator[str]:
    """Every docstring of a module, those behind its constants among them."""
    for node in ast.walk(module):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            for statement in node.body:
                value = statement.value if isinstance(statement, ast.Expr) else None
                if isinstance(value, ast.Constant) and isinstance(value.value, str):
                    yield value.value


def test_every_docstring_has_its_own_noun() -> None:
    """None is a genitive, or needs another one to say what it is about."""
    nameless = [
        f"{path.relative_to(ROOT)}: {text.splitlines()[0]}"
        for folder in ("tactile_cdma", "benchmarks", "torture", "examples", "firmware", "tools")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for text in docstrings(ast.parse(path.read_text(encoding="utf-8")))
        if re.match(r"(Of|As|The same|Those|Likewise)\b", text)
    ]
    assert not nameless


HEART = ("framing", "words", "code")
JUDGES = (
    "certificate", "frame_reader", "frame_stream", "stream_state", "fit", "code", "words",
    "sparse", "detect",
)  # fmt: skip
SPELT = {"ρ": "rho", "silent": "silen", "hole": "anew", "speak": "spoke", "held": "kept"}
"""Names that code cannot spell, or spells in another form."""
OTHERS = {
    "verdict": {"look", "looks"},
    "doubtful": {"dubious", "suspect", "suspects", "uncertain"},
    "speak": {"talk", "talks", "talking", "heard"},
    "node": {"tag", "sensel"},
    "taxel": {"sensel", "tactel"},
    "row": {"codeword", "sequence_row"},
    "atom": {"ghost", "echo"},
    "loss": {"gone", "missed"},
    "clause": {"criterion", "criteria"},
    "offset": {"pedestal"},
}
"""Words that once stood, or might, for what has a name."""


def glossary() -> list[str]:
    text = (ROOT / "docs" / "architecture.md").read_text()
    [section] = re.findall(r"^## Glossary\n.*?(?=^## )", text, re.MULTILINE | re.DOTALL)
    return [
        name for names in re.findall(r"^- \*(.+?)\*:", section, re.M) for name in names.split(", ")
    ]


def parts_of_names() -> Iterator[tuple[str, Path]]:
    """The parts between underscores of all names in the heart, in both languages."""
    for folder in HEART:
        for path in (ROOT / "tactile_cdma" / folder).rglob("*.py"):
            for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
                if token.type == tokenize.NAME and not keyword.iskeyword(token.string):
                    yield from ((part, path) for part in token.string.lower().split("_"))
    for name in JUDGES:
        for path in (ROOT / "kernel").glob(f"{name}.[ch]"):
            code = re.sub(r"/\*.*?\*/|\"[^\"\n]*\"", " ", path.read_text(), flags=re.DOTALL)
            yield from (
                (part, path)
                for word in re.findall(r"\w+", code)
                for part in word.lower().split("_")
            )


@pytest.mark.parametrize("name", glossary())
def test_what_the_glossary_names_is_so_named_in_the_code(name: str) -> None:
    spelt = SPELT.get(name, name)
    sources = (*(ROOT / "tactile_cdma").rglob("*.py"), *(ROOT / "kernel").glob("*.[ch]"))
    assert any(re.search(rf"(?i){spelt}", path.read_text()) for path in sources)


def test_nothing_has_another_name_in_the_heart() -> None:
    parts = list(parts_of_names())
    assert len(parts) > 5000
    others = {other for words in OTHERS.values() for other in words}
    assert {(part, path.name) for part, path in parts if part in others} == set()


def test_the_glossary_has_one_entry_for_each_name() -> None:
    names = glossary()
    assert 20 <= len(names) == len(set(names)) and set(OTHERS) <= set(names)


IN_TEXT = re.compile(r"`((?:tactile-cdma|make) [^`…]+)`")
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
TARGETS = {
    *re.findall(r"^([a-z][a-z-]*):(?!=)", MAKEFILE, re.MULTILINE),
    *(f"bench-{path.stem}" for path in ROOT.glob("benchmarks/*.py")),
    *(f"bench-{path.parent.name}" for path in ROOT.glob("benchmarks/*/__main__.py")),
}
[VARIABLES] = re.findall(r"^VARIABLES = (.*)", MAKEFILE, re.MULTILINE)
SKIN_PARAMETERS = {parameter.name for parameter in PARAMETERS}


PRESENT = [page for page in PAGES if page.name != "CHANGELOG.md"]
"""Pages whose commands are today's."""
INDENTED = sorted(
    {
        command
        for page in PRESENT
        for block in blocks(page)
        for command in block.commands
        if command.startswith(("tactile-cdma ", "make ", "ros2 "))
    }
)
IN_SENTENCES = sorted(
    {
        command
        for page in PRESENT
        for command in IN_TEXT.findall(" ".join(page.read_text(encoding="utf-8").split()))
    }
)


@pytest.mark.parametrize("command", [c for c in INDENTED if c.startswith("tactile-cdma ")])
def test_the_command_line_takes_it(command: str, record_property: Record) -> None:
    record_property("commands", 1)
    words = shlex.split(command)[1:]
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            make_parser().parse_args(words)
        except SystemExit as end:
            pytest.fail(f"{end.code}: {said.getvalue()}")


@pytest.mark.parametrize("command", [c for c in IN_SENTENCES if c.startswith("tactile-cdma ")])
def test_the_command_line_has_the_options(command: str, record_property: Record) -> None:
    """In sentences, arguments may be left out."""
    record_property("commands", 1)
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
def test_make_has_the_target_and_the_variables(command: str, record_property: Record) -> None:
    record_property("commands", 1)
    words = shlex.split(command)[1:]
    assigned = {word.partition("=")[0] for word in words if "=" in word}
    targets = {word for word in words if "=" not in word}
    assert assigned <= set(VARIABLES.split())
    assert targets and targets <= TARGETS


@pytest.mark.parametrize("command", [c for c in INDENTED if c.startswith("ros2 launch ")])
def test_the_launch_file_has_the_arguments(command: str, record_property: Record) -> None:
    record_property("commands", 1)
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
    body = (ROOT / "tactile_cdma/ros/body/node.py").read_text(encoding="utf-8")
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


def test_the_changelog_can_be_read_before_an_update() -> None:
    """60 lines a release: what to change first, and links to the rest."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    releases = re.split(r"^## ", text, flags=re.MULTILINE)[1:]
    assert [one.partition("\n")[0] for one in releases if len(one.splitlines()) > 60] == []
