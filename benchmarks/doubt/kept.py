# SPDX-License-Identifier: Apache-2.0

"""Results of recordings that are finished, kept in a file, so that a run that ended early goes on.

They count as long as the code that they are of is the same, line by line.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from types import TracebackType
from typing import TypeAlias

from .tally import Tally

Result: TypeAlias = tuple[Tally, list[str]]
"""Counts of a recording, and its first false claims."""
PROJECT = "tactile_cdma", "benchmarks", "test"


class Kept:
    """Results by name and number of the recording; a context that closes their file.

    The file has a line of JSON for the code and one for each result.
    """

    def __init__(self, path: Path, code: str) -> None:
        """Results of other code are dropped; so is a last line that was not written whole."""
        self.found: dict[tuple[str, int], Result] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_text(encoding="utf-8").splitlines(True) if path.exists() else []
        whole = [line for line in lines if line.endswith("\n")]
        is_same = bool(whole) and json.loads(whole[0]) == code
        for line in whole[1:] if is_same else ():
            name, seed, counts, complaints = json.loads(line)
            self.found[name, seed] = Tally(**counts), complaints
        text = "".join(whole) if is_same else json.dumps(code) + "\n"
        self._file = path.open("w", encoding="utf-8")
        self._file.write(text)
        self._file.flush()

    def __enter__(self) -> Kept:
        return self

    def __exit__(
        self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, name: str, seed: int, result: Result) -> None:
        """Keep one more."""
        self.found[name, seed] = tally, complaints = result
        line = [name, seed, tally._asdict(), complaints]
        print(json.dumps(line, default=int), file=self._file, flush=True)  # numpy's counts, too


def loaded_code() -> str:
    """Return a digest of all loaded modules of this project, the compiled one among them."""
    digest = hashlib.sha256()
    for name, module in sorted(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file and name.split(".")[0] in PROJECT:
            digest.update(Path(file).read_bytes())
    return digest.hexdigest()
