# SPDX-License-Identifier: Apache-2.0

"""Hostile input: a slice of fuzzing, files made to exhaust memory, endless garbage, and firmware.

`make fuzz` searches the same targets, and the harnesses of firmware/fuzz, for as long as one likes.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Set
from pathlib import Path
from tempfile import TemporaryDirectory

from tactile_cdma.base.errors import TactileError

from ..outcome import Outcome, Plan
from . import bombs, garbage
from .both_languages import same_answers, same_samples
from .harnesses import BUILD, build
from .sync_storms import storms
from .target import CRASH, SLOW, UNCOUNTED, WRONG, Target, inputs, trying
from .targets import GROUPS

SLICE_S = {True: 0.12, False: 18.0}
"""Processor time for a target, s."""
WAITS = 1.5
"""Time for it, of that: most wait for a disk now and then, beside other campaigns for long."""
QUICK_BYTES, FULL_BYTES = 2 << 20, 50 << 20
"""Most bytes of each kind of garbage."""
GARBAGE_S = {True: 0.1, False: 8.0}
"""Most processor time for each kind of garbage, s."""
LONG = {"millions of values"}
"""Bombs that take seconds, and many on a busy machine."""
CRAFTED_BYTES = {True: 1 << 18, False: 4 << 20}


def run(plan: Plan) -> Iterator[Outcome]:
    """Mutations of what every reader reads, then bombs and garbage, then the firmware."""
    for fault, targets in GROUPS.items():
        yield tried(fault, targets, plan)
    with TemporaryDirectory() as folder:
        yield yaml_bombs(Path(folder), bombs.YAML_BOMBS.keys() - (LONG if plan.quick else set()))
        yield waiting(Path(folder))
        yield oversized(Path(folder), CRAFTED_BYTES[plan.quick])
    yield fed(plan)
    build("replay-native")
    yield same_answers(BUILD / "replay" / "replay", plan)
    yield same_samples(BUILD / "replay" / "replay", plan)
    yield from storms(plan)


def tried(fault: str, targets: Sequence[Target], plan: Plan) -> Outcome:
    """Run seeds and mutations of each target for a slice of time."""
    kinds, done, slice_s = Counter[str](), 0, SLICE_S[plan.quick]
    for target in targets:
        with trying(target) as attempt:
            until_s, latest_s = time.thread_time() + slice_s, time.monotonic() + WAITS * slice_s
            for data in inputs(target, plan.seed):
                done += 1
                if (find := attempt(data)) is not None:
                    print(f"{target.name}, {data!r}: {find.text}", file=sys.stderr)
                    kinds[find.kind] += 1
                if time.thread_time() > until_s or time.monotonic() > latest_s:
                    break
    return _outcome(fault, done, kinds, f"{len(targets)} targets")


def yaml_bombs(folder: Path, names: Set[str]) -> Outcome:
    """YAML made to fill the memory, for every reader of YAML; large ones for one reader only."""
    cases = []
    for number, name in enumerate(sorted(names)):
        path = folder / f"bomb{number}.yaml"
        path.write_bytes(bombs.YAML_BOMBS[name]())
        small = path.stat().st_size < 1 << 20
        readers = list(bombs.YAML.values()) if small else [bombs.YAML["parameters"]]
        cases += [(read, path, small) for read in readers]
    return _refused("YAML made to fill the memory or the terminal", cases)


def waiting(folder: Path) -> Outcome:
    """FIFOs, devices and impossible names, for every reader of files."""
    readers = [*bombs.YAML.values(), *bombs.OTHERS.values()]
    cases = [(read, path, True) for path in bombs.never_ending(folder) for read in readers]
    return _refused("FIFO, device, folder or impossible name for a file", cases)


def oversized(folder: Path, size: int) -> Outcome:
    """A CSV file above the limit, and a recording whose headers claim a megabyte each."""
    path = folder / "scope.csv"
    bombs.oversized_csv(path)
    outcome = _refused("oversized or crafted files", [(bombs.OTHERS["scope"], path, True)])
    try:
        with bombs.in_time():
            bombs.parse_crafted(size)
    except TimeoutError:
        return Outcome(outcome.fault, 2, crashes=outcome.crashes, hangs=outcome.hangs + 1)
    return Outcome(outcome.fault, 2, crashes=outcome.crashes, hangs=outcome.hangs)


def _refused(fault: str, cases: Sequence[tuple[Callable[[Path], object], Path, bool]]) -> Outcome:
    """Each reader must refuse its file, in time and with little memory."""
    kinds, most = Counter[str](), 0
    for read, path, measured in cases:
        try:
            most = max(most, bombs.refuse(read, path, measured))
        except TimeoutError:
            kinds[SLOW] += 1
        except Exception:  # any at all is a defect
            traceback.print_exc()
            kinds[CRASH] += 1
    kinds[CRASH] += most > bombs.MOST_HELD
    return _outcome(fault, len(cases), kinds, f"at most {most / 1e6:.1f} MB held")


def fed(plan: Plan) -> Outcome:
    """Endless garbage: what a pipeline holds of it must be bounded."""
    most, total, kinds = 0, 0, Counter[str]()
    size = QUICK_BYTES if plan.quick else FULL_BYTES
    for kind in garbage.KINDS:
        try:
            pipeline = garbage.pipeline_for(kind)
            held = garbage.feed(kind, plan.seed, size, GARBAGE_S[plan.quick], pipeline)
        except TactileError:
            kinds[CRASH] += 1
            continue
        most, total = max(most, held.most), total + held.fed
        kinds[CRASH] += held.most > garbage.MOST_HELD
    said = f"{total / 1e6:.0f} MB in all, at most {most / 1e6:.1f} MB held"
    return _outcome("endless garbage from a port", len(garbage.KINDS), kinds, said)


def _outcome(fault: str, times: int, kinds: Counter[str], said: str) -> Outcome:
    return Outcome(
        fault=fault,
        times=times,
        wrong_values=kinds[WRONG],
        uncounted_losses=kinds[UNCOUNTED],
        crashes=kinds[CRASH],
        hangs=kinds[SLOW],
        said=said,
    )
