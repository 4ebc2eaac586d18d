# SPDX-License-Identifier: Apache-2.0

"""Searches one target, guided by coverage if atheris is installed, otherwise by mutations.

python -m torture.fuzz.worker TARGET FOLDER RUNS SECONDS SEED: inputs with new coverage are kept in
FOLDER/seeds, finds in FOLDER/finds. The statistics go to stderr in libFuzzer's format.
"""

from __future__ import annotations

import hashlib
import importlib.util
import resource
import sys
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .target import Target

ROOM = 1 << 30
"""Growth allowed to the process, bytes; asking for more raises MemoryError, which is a find."""
DEAD_S = 60
"""Wall-clock time after which libFuzzer ends a process whose input cannot be given up, s."""
NUMERIC = [
    "tactile_cdma.code",
    "tactile_cdma.driver.clock",
    "tactile_cdma.readings.pressure",
    "tactile_cdma.readings.taxels",
    "tactile_cdma.sim",
    "tactile_cdma.words",
]
"""Modules that take arrays, not bytes: excluded from coverage, for speed."""


def main() -> int:
    """Search."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    runs, seconds, seed = map(int, sys.argv[3:6])
    if importlib.util.find_spec("atheris") is None:
        _by_chance(name, folder, runs, seconds, seed)
        return 0
    import atheris

    with atheris.instrument_imports(include=["tactile_cdma"], exclude=NUMERIC):
        one_input, target = _prepare(name, folder)
    for known in target.seeds().values():
        (folder / "seeds" / hashlib.sha1(known).hexdigest()).write_bytes(known)
    options = [
        str(folder / "seeds"),
        f"-runs={runs}",
        f"-max_total_time={seconds}",
        f"-seed={seed}",
        f"-max_len={target.most_bytes}",
        f"-artifact_prefix={folder / 'finds'}/",
        f"-timeout={DEAD_S}",
        "-rss_limit_mb=4096",
        "-print_final_stats=1",
    ]
    atheris.Setup([sys.argv[0], *options], one_input)
    atheris.Fuzz()  # ends the process
    return 0


def _prepare(name: str, folder: Path) -> tuple[Callable[[bytes], None], Target]:
    """Return a function that runs an input and keeps it if it is a new find."""
    from .target import trying
    from .targets import TARGETS

    target, known = TARGETS[name], set[str]()
    attempt = trying(target).__enter__()  # until the process ends

    def one_input(data: bytes) -> None:
        find = attempt(data)
        if find is None or find.where in known:
            return
        known.add(find.where)
        path = folder / "finds" / f"{name}-{hashlib.sha1(data).hexdigest()[:12]}"
        path.write_bytes(data)
        path.with_suffix(f".{find.kind}").write_text(f"{find.where}\n{find.text}\n")

    for data in target.seeds().values():
        one_input(data)  # caches are filled before memory is limited
    limit = _virtual_bytes() + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    return one_input, target


def _by_chance(name: str, folder: Path, runs: int, seconds: int, seed: int) -> None:
    from .target import inputs

    one_input, target = _prepare(name, folder)
    begun_s, done = time.monotonic(), 0
    for data in islice(inputs(target, seed), runs):
        if time.monotonic() > begun_s + seconds:
            break
        one_input(data)
        done += 1
    per_s = done / max(time.monotonic() - begun_s, 1e-3)
    print(f"stat::number_of_executed_units: {done}", file=sys.stderr)
    print(f"stat::average_exec_per_sec: {per_s:.0f}", file=sys.stderr)


def _virtual_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


if __name__ == "__main__":
    sys.exit(main())
