# SPDX-License-Identifier: Apache-2.0

"""Runs some conditions with other values of some constants, in a process of its own; see `ablate`.

The values are in place before the package is loaded: what other constants, defaults of arguments
and settings of the kernel are made of them follows.

    python -m benchmarks.doubt.trial < task > counts
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

from tools.constants import replaced

if TYPE_CHECKING:
    from .tally import Condition, Tally

Overrides: TypeAlias = Mapping[str, Mapping[str, float]]
"""Other values of constants, by module and name."""
MOST_BYTES = 4 << 30
"""Memory of a trial: without some limit the package may want all there is."""


@dataclass(frozen=True)
class Task:
    """What is tried.

    conditions: names; all where there is none. store: a folder for recordings, which are rendered
    only once.
    """

    store: str
    conditions: Sequence[str] = ()
    frames: int = 24
    seed: int = 0
    overrides: Overrides = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """What came of a condition. seconds: of the processor, without rendering."""

    rough: bool
    seconds: float
    tally: Tally


class TrialError(Exception):
    """The package did not survive other values of its constants, or became too slow."""


def try_out(task: Task, timeout_s: float) -> dict[str, Run]:
    """What comes of each condition of a task, in a process of its own. Raises TrialError."""
    from .tally import Tally

    command = [sys.executable, "-m", "benchmarks.doubt.trial"]
    quiet = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "QUICK": ""}
    try:
        done = subprocess.run(
            command,
            input=json.dumps(asdict(task)),
            capture_output=True,
            text=True,
            timeout=timeout_s,
            env=quiet,
        )
    except subprocess.TimeoutExpired:
        raise TrialError(f"takes more than {timeout_s:.0f} s") from None
    if done.returncode:
        reason = done.stderr.strip().rsplit("\n", 1)[-1]
        raise TrialError(reason or f"exit code {done.returncode}")
    return {
        name: Run(rough, seconds, Tally(*counts))
        for name, rough, seconds, counts in json.loads(done.stdout)
    }


def put(overrides: Overrides) -> None:
    """Have modules that are loaded from now on made with other values of their constants."""
    sys.meta_path.insert(0, _Finder(overrides))


class _Loader(SourceFileLoader):
    """Compiles a module with other values."""

    def __init__(self, spec: ModuleSpec, values: Mapping[str, float]) -> None:
        super().__init__(spec.name, str(spec.origin))
        self._values = values

    def get_code(self, fullname: str) -> CodeType:
        source = Path(self.path).read_text(encoding="utf-8")
        code: CodeType = compile(replaced(source, self._values), self.path, "exec")
        return code


class _Finder(MetaPathFinder):
    """Finds the modules that have other values."""

    def __init__(self, overrides: Overrides) -> None:
        self._overrides = overrides

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in self._overrides:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec:
            spec.loader = _Loader(spec, self._overrides[fullname])
        return spec


def conditions() -> Iterator[Condition]:
    """The conditions in which nodes send words."""
    from . import lines, mixtures, touches, zeros

    for source in (lines, mixtures, touches, zeros):
        yield from source.conditions()


def remember_renderings(folder: Path) -> list[float]:
    """Have recordings that were rendered before taken from a folder; others go there.

    Before conditions are loaded, which have the function's name from its module. What comes back
    gets the time that every recording took, s.
    """
    from test.support import independent_line

    render, spent_s = independent_line.render, list[float]()

    def timed(*arguments: Any) -> independent_line.Recording:
        begin = time.process_time()
        recording = remembered(*arguments)
        spent_s.append(time.process_time() - begin)
        return recording

    def remembered(*arguments: Any) -> independent_line.Recording:
        digest = hashlib.sha256(repr(arguments).encode()).hexdigest()
        path = folder / f"{digest[:32]}.pickle"
        if path.exists():
            kept: independent_line.Recording = pickle.loads(path.read_bytes())  # noqa: S301  (ours)
            return kept
        recording = render(*arguments)
        path.write_bytes(pickle.dumps(recording))
        return recording

    vars(independent_line)["render"] = timed
    return spent_s


def main() -> None:
    task = Task(**json.load(sys.stdin))
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    put(task.overrides)
    spent_s = remember_renderings(Path(task.store))
    found = []
    for condition in conditions():
        if not task.conditions or condition.name in task.conditions:
            spent_s.clear()
            begin = time.process_time()
            tally, _ = condition.run(task.frames, task.seed)
            seconds = time.process_time() - begin - sum(spent_s)
            found.append([condition.name, condition.rough, round(seconds, 4), list(tally)])
    json.dump(found, sys.stdout, default=int)  # counts of numpy, too


if __name__ == "__main__":
    main()
