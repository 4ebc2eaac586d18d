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

"""One target, searched in a process of its own: by coverage with atheris, else by mutations alone.

python -m torture.fuzz.worker TARGET FOLDER RUNS SECONDS SEED: seeds are taken from FOLDER/seeds,
finds left in FOLDER/finds. What it came to is told on stderr, in the words of libFuzzer.
"""

from __future__ import annotations

import hashlib
import importlib.util
import random
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

from .mutation import mutated

ROOM = 1 << 30
"""Bytes that a process may grow by; what asks for more gets a MemoryError, which is a find."""
DEAD_S = 60
"""Wall-clock time after which an input that cannot even be given up ends the process."""


def main() -> int:
    """Search; 0 where nothing ended the process."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    runs, seconds, seed = map(int, sys.argv[3:6])
    if importlib.util.find_spec("atheris") is None:
        _by_chance(name, folder, runs, seconds, seed)
        return 0
    import atheris

    with atheris.instrument_imports(include=["tactile_cdma"]):
        one_input, most_bytes = _prepare(name, folder)
    options = [
        str(folder / "seeds"),
        f"-runs={runs}",
        f"-max_total_time={seconds}",
        f"-seed={seed}",
        f"-max_len={most_bytes}",
        f"-artifact_prefix={folder / 'finds'}/",
        f"-timeout={DEAD_S}",
        "-rss_limit_mb=4096",
        "-print_final_stats=1",
    ]
    atheris.Setup([sys.argv[0], *options], one_input)
    atheris.Fuzz()  # ends the process
    return 0


def _prepare(name: str, folder: Path) -> tuple[Callable[[bytes], None], int]:
    """What takes an input, and how long inputs may be."""
    from .target import trying
    from .targets import TARGETS

    target = TARGETS[name]
    for seed in target.seeds().values():
        (folder / "seeds" / hashlib.sha1(seed).hexdigest()).write_bytes(seed)
    attempt = trying(target).__enter__()  # until the process ends

    known: set[str] = set()

    def one_input(data: bytes) -> None:
        find = attempt(data)
        if find is None or find.where in known:
            return
        known.add(find.where)
        path = folder / "finds" / f"{name}-{hashlib.sha1(data).hexdigest()[:12]}"
        path.write_bytes(data)
        path.with_suffix(f".{find.kind}").write_text(f"{find.where}\n{find.text}\n")

    for seed in target.seeds().values():
        one_input(seed)  # what is made once only is made before memory is limited
    limit = _virtual_bytes() + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    return one_input, target.most_bytes


def _by_chance(name: str, folder: Path, runs: int, seconds: int, seed: int) -> None:
    one_input, most_bytes = _prepare(name, folder)
    seeds = [path.read_bytes() for path in sorted((folder / "seeds").iterdir())]
    rng, until_s = random.Random(seed), time.monotonic() + seconds
    done, begun_s = 0, time.monotonic()
    while done < runs and time.monotonic() < until_s:
        one_input(mutated(rng, seeds)[:most_bytes])
        done += 1
    rate = done / max(time.monotonic() - begun_s, 1e-3)
    print(f"stat::number_of_executed_units: {done}", file=sys.stderr)
    print(f"stat::average_exec_per_sec: {rate:.0f}", file=sys.stderr)


def _virtual_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


if __name__ == "__main__":
    sys.exit(main())
