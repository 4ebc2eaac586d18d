# SPDX-License-Identifier: Apache-2.0

"""Every source file begins with an SPDX line that names the licence."""

import os
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
COMMENTS = {".py": "#", ".c": "//", ".h": "//", ".cmake": "#"}
NOT_OURS = {"build", "dist", "install", "log", "node_modules"}
NOTICE = "SPDX-License-Identifier: Apache-2.0"


def sources() -> Iterator[Path]:
    """Source files of this repository."""
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [name for name in folders if name[0] not in "._" and name not in NOT_OURS]
        yield from (Path(folder, name) for name in names if Path(name).suffix in COMMENTS)


def test_every_source_file_names_the_licence() -> None:
    missing = []
    for source in sources():
        text = source.read_text(encoding="utf-8")
        first = text.splitlines()[text.startswith("#!") :][:1]
        if text and first != [f"{COMMENTS[source.suffix]} {NOTICE}"]:
            missing.append(source.relative_to(ROOT).as_posix())
    assert missing == []


def test_the_licence_is_the_one_they_name() -> None:
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "Apache License" in text and "Version 2.0" in text
