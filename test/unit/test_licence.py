# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Every source file begins with the licence, as ament_copyright wants it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COMMENTS = {".py": "#", ".c": "//", ".h": "//", ".cmake": "#"}
NOT_OURS = {"build", "dist", "install", "log", "node_modules"}
NOTICE = "Copyright 2026 tactile_cdma maintainers"


def sources() -> Iterator[Path]:
    """What ament_copyright looks at."""
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [name for name in folders if name[0] not in "._" and name not in NOT_OURS]
        yield from (Path(folder, name) for name in names if Path(name).suffix in COMMENTS)


def header() -> list[str]:
    """The lines that begin this file."""
    lines = Path(__file__).read_text(encoding="utf-8").splitlines()
    return [line[2:] for line in lines[: next(i for i, line in enumerate(lines) if not line)]]


def test_the_header_is_that_of_the_licence() -> None:
    """The same words that the licence itself asks to be put there."""
    licence = " ".join((ROOT / "LICENSE").read_text(encoding="utf-8").split())
    assert header()[0] == NOTICE
    assert " ".join(" ".join(header()[1:]).split()) in licence


def test_every_source_file_begins_with_it() -> None:
    missing = []
    for source in sources():
        text = source.read_text(encoding="utf-8")
        lines = text.splitlines()[text.startswith("#!") :]
        expected = [f"{COMMENTS[source.suffix]} {line}".rstrip() for line in header()]
        # ament_copyright reads the whole of the first comment: the header must be all of it
        if text and lines[: len(expected) + 1] != [*expected, ""]:
            missing.append(source.relative_to(ROOT).as_posix())
    assert missing == []
