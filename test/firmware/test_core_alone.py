# SPDX-License-Identifier: Apache-2.0

"""firmware/core depends on no board: with nothing but core/ to include from, it compiles."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import CORE, STRICT, need, run

SYSTEM = {"stdbool.h", "stddef.h", "stdint.h", "string.h"}
"""All that core/ takes from a C library; of string.h, memcpy, memmove and memset."""


@pytest.mark.parametrize("source", sorted(CORE.glob("*.[ch]")), ids=lambda path: path.name)
def test_a_core_file_includes_only_core_files(source: Path, tmp_path: Path) -> None:
    includes = [
        line.split()[1] for line in source.read_text().splitlines() if line.startswith("#include")
    ]
    assert {name.strip("<>") for name in includes if name.startswith("<")} <= SYSTEM
    used = run(need("cc"), *STRICT, "-MM", source, cwd=tmp_path).replace("\\\n", " ").split()[1:]
    assert used and {Path(name).resolve().parent for name in used} == {CORE}


@pytest.mark.parametrize("source", sorted(CORE.glob("*.c")), ids=lambda path: path.name)
def test_a_core_file_compiles_with_core_as_its_only_include_path(
    source: Path, tmp_path: Path
) -> None:
    run(need("cc"), *STRICT, "-fsyntax-only", source, cwd=tmp_path)
