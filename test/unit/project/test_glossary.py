# SPDX-License-Identifier: Apache-2.0

"""The glossary of docs/architecture.md: its names are those of the code, and nothing has two."""

import io
import keyword
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[3]
HEART = ("framing", "words", "code")
JUDGES = ("certificate", "frame_reader", "frame_stream", "fit", "code", "words", "sparse", "detect")
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
}
"""Words that once stood, or might, for what has a name."""


def glossary() -> list[str]:
    text = (CHECKOUT / "docs" / "architecture.md").read_text()
    [section] = re.findall(r"^## Glossary\n.*?(?=^## )", text, re.MULTILINE | re.DOTALL)
    return [
        name for names in re.findall(r"^- \*(.+?)\*:", section, re.M) for name in names.split(", ")
    ]


def parts_of_names() -> Iterator[tuple[str, Path]]:
    """The parts between underscores of all names in the heart, in both languages."""
    for folder in HEART:
        for path in (CHECKOUT / "tactile_cdma" / folder).rglob("*.py"):
            for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
                if token.type == tokenize.NAME and not keyword.iskeyword(token.string):
                    yield from ((part, path) for part in token.string.lower().split("_"))
    for name in JUDGES:
        for path in (CHECKOUT / "kernel").glob(f"{name}.[ch]"):
            code = re.sub(r"/\*.*?\*/|\"[^\"\n]*\"", " ", path.read_text(), flags=re.DOTALL)
            yield from (
                (part, path)
                for word in re.findall(r"\w+", code)
                for part in word.lower().split("_")
            )


@pytest.mark.parametrize("name", glossary())
def test_what_the_glossary_names_is_so_named_in_the_code(name: str) -> None:
    spelt = SPELT.get(name, name)
    sources = (*(CHECKOUT / "tactile_cdma").rglob("*.py"), *(CHECKOUT / "kernel").glob("*.[ch]"))
    assert any(re.search(rf"(?i){spelt}", path.read_text()) for path in sources)


def test_nothing_has_another_name_in_the_heart() -> None:
    parts = list(parts_of_names())
    assert len(parts) > 5000
    others = {other for words in OTHERS.values() for other in words}
    assert {(part, path.name) for part, path in parts if part in others} == set()


def test_the_glossary_has_one_entry_for_each_name() -> None:
    names = glossary()
    assert 20 <= len(names) == len(set(names)) and set(OTHERS) <= set(names)
