# SPDX-License-Identifier: Apache-2.0

"""Rows of tables of numbers, as spreadsheets and programs write them: CSV of many kinds."""

import re
from collections.abc import Container, Iterator
from itertools import chain, islice, zip_longest
from pathlib import Path

from .errors import TactileError
from .named_file import naming, read_text
from .text import lines_of

_AROUND = '" \t'
"""Characters stripped from a cell's ends: spreadsheets like quotes."""
_EMPTY = _AROUND + ",;"
_TOLD = re.compile('"?sep=(.)"?')
"""A first line by which spreadsheets tell the separator."""


def table_rows(
    path: Path, most_bytes: int, error: type[TactileError], units: Container[str]
) -> Iterator[tuple[int, list[str]]]:
    """Yield the line (from 1) and the cells of a table's heading, and then those of each row.

    Cells are separated by what a first line such as `sep=;` says, else by commas, semicolons or
    tabs, or by blanks if the heading has none of these. Decimal commas are understood where commas
    separate nothing. Quotes around cells are dropped, and so are empty cells at the end, lines
    without cells, and those that begin with #. A row of units below the heading joins it; units: in
    small letters. Raises error for a file that cannot be read, or is empty.
    """
    with naming(path, error):
        text = read_text(path, most_bytes)
    rows = (
        (number, line)
        for number, line in enumerate(lines_of(text), 1)
        if line.strip(_EMPTY) and not line.lstrip(_EMPTY).startswith("#")
    )
    first, heading = next(rows, (0, ""))
    if told := _TOLD.fullmatch(heading.strip()):
        first, heading = next(rows, (0, ""))
    if not first:
        raise error(f"{path}: the file is empty")
    most = max(",;\t", key=heading.count)
    separator = told[1] if told else most if most in heading else None

    def cells(line: str, wanted: int = 0) -> list[str]:
        text = line if separator == "," else line.replace(",", ".")
        found = [cell.strip(_AROUND) for cell in text.split(separator)]
        while len(found) > wanted and not found[-1]:
            found.pop()
        return found

    names, below = cells(heading), [*islice(rows, 1)]
    second = below[0][1] if below else ""
    if not re.search(r"\d", second) and any(word in units for word in words(second)):
        pairs = zip_longest(names, cells(second, len(names)), fillvalue="")
        names = [" ".join(filter(None, pair)) for pair in pairs]
        below = []
    yield first, names
    for number, line in chain(below, rows):
        yield number, cells(line, len(names))


def words(text: str) -> list[str]:
    """Return the words of a heading, in small letters."""
    return re.findall("[^\\W\\d_]+", text.lower())
