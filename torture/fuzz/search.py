# SPDX-License-Identifier: Apache-2.0

"""Runs the search of a target in its own process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from .target import CRASH

MEMORY = Path("/dev/shm")
"""Folder for inputs that have to be files, if it exists."""
MARGIN_S = 120
"""Time beyond its limit after which a search counts as a hang."""


@dataclass(frozen=True, slots=True)
class Found:
    """The result of a search.

    inputs: number tried. per_s: inputs per second. coverage: branches reached; 0: not measured.
    peak_mb: largest memory of the process. finds: kind of each, and its file with a description.
    """

    target: str
    inputs: int
    per_s: int
    coverage: int
    peak_mb: int
    finds: tuple[tuple[str, str], ...]

    def __str__(self) -> str:
        head = (
            f"{self.target:<12} inputs={self.inputs} per_s={self.per_s} coverage={self.coverage} "
            f"peak_mb={self.peak_mb} finds={len(self.finds)}"
        )
        return "\n".join([head, *(f"    {kind}: {text}" for kind, text in self.finds)])


def search(target: str, folder: Path, runs: int, seconds: int, seed: int) -> Found:
    """Try up to `runs` inputs for up to `seconds`; seeds and finds stay in the folder."""
    for name in ("seeds", "finds"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "torture.fuzz.worker", target, str(folder)]
    command += [str(number) for number in (runs, seconds, seed)]
    with TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as scratch:
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "TMPDIR": scratch}
        try:
            done = subprocess.run(
                command, capture_output=True, timeout=seconds + MARGIN_S, env=environment
            )
            said, ended = done.stderr.decode(errors="replace"), done.returncode
        except subprocess.TimeoutExpired as error:
            said, ended = (error.stderr or b"").decode(errors="replace"), -1
    left = [path for path in sorted((folder / "finds").iterdir()) if path.suffix]
    finds = [(path.suffix[1:], f"{path}: {path.read_text().splitlines()[0]}") for path in left]
    if ended:
        finds.append((CRASH, f"{folder}: the process ended with {ended}: {said[-2000:]}"))
    return Found(
        target=target,
        inputs=_last(r"number_of_executed_units: (\d+)", said),
        per_s=_last(r"average_exec_per_sec: +(\d+)", said),
        coverage=_last(r"cov: (\d+)", said),
        peak_mb=_last(r"peak_rss_mb: +(\d+)", said),
        finds=tuple(finds),
    )


def _last(pattern: str, text: str) -> int:
    found = re.findall(pattern, text)
    return int(found[-1]) if found else 0
