# SPDX-License-Identifier: Apache-2.0

"""Documents: every link has a target, every picture a reader, every docstring a noun; sizes."""

import ast
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from test.support.programs import run_python

ROOT = Path(__file__).resolve().parents[3]
MOST_WORDS = 32_000
"""Of README and docs/*.md, marks of tables included. Chosen; 30,000 is the goal."""
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted(ROOT.glob("docs/*.md")),
    *sorted(ROOT.glob("firmware/**/README.md")),
]
LINK = re.compile(r"\]\(([^)\s#]*)(?:#([^)\s]*))?\)")
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors that a forge makes of the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", text.lower()).strip().replace(" ", "-") for text in headings}


@pytest.mark.parametrize("page", [page for page in PAGES if "node_modules" not in page.parts])
def test_every_link_leads_somewhere(page: Path) -> None:
    broken = []
    for target, anchor in LINK.findall(CODE.sub("", page.read_text(encoding="utf-8"))):
        if target.startswith(("http:", "https:", "mailto:")):
            continue
        there = (page.parent / target).resolve() if target else page
        if not there.exists() or (anchor and anchor not in anchors(there)):
            broken.append(f"{target}#{anchor}")
    assert broken == []


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


def test_there_is_not_more_to_read_than_one_can() -> None:
    pages = [ROOT / "README.md", *ROOT.glob("docs/*.md")]
    texts = [page.read_text(encoding="utf-8") for page in pages]
    assert len(texts[0].splitlines()) <= 130
    assert len(pages) - 1 <= 20
    assert sum(len(text.split()) for text in texts) <= MOST_WORDS


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
