# SPDX-License-Identifier: Apache-2.0

"""Rows of tables of numbers, as spreadsheets and programs write them: CSV of many kinds."""

import re
from collections.abc import Container, Iterator
from itertools import zip_longest
from pathlib import Path

from .errors import TactileError
from .named_file import naming, read_text

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
    used = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip(_EMPTY) and not line.lstrip(_EMPTY).startswith("#")
    ]
    told = _TOLD.fullmatch(used[0][1].strip()) if used else None
    used = used[1:] if told else used
    if not used:
        raise error(f"{path}: the file is empty")
    (first, heading), *rows = used
    most = max(",;\t", key=heading.count)
    separator = told[1] if told else most if most in heading else None

    def cells(line: str, wanted: int = 0) -> list[str]:
        text = line if separator == "," else line.replace(",", ".")
        found = [cell.strip(_AROUND) for cell in text.split(separator)]
        while len(found) > wanted and not found[-1]:
            found.pop()
        return found

    names, below = cells(heading), rows[0][1] if rows else ""
    if not re.search(r"\d", below) and any(word in units for word in words(below)):
        pairs = zip_longest(names, cells(below, len(names)), fillvalue="")
        names = [" ".join(filter(None, pair)) for pair in pairs]
        del rows[0]
    yield first, names
    for number, line in rows:
        yield number, cells(line, len(names))


def words(text: str) -> list[str]:
    """Return the words of a heading, in small letters."""
    return re.findall("[^\\W\\d_]+", text.lower())
