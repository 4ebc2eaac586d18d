# SPDX-License-Identifier: Apache-2.0

"""The firmware under hostile commands, memories, samples and sync pulses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ..outcome import Outcome, Plan
from .both_languages import same_answers, same_samples
from .c_fuzzing import BUILD, Fuzzed, Kind, best_kind, build, fuzz, harnesses
from .sync_storms import storms

WHAT = {
    "framing": "bytes to the C packet reader, packets of its writer",
    "setup": "CONFIGURE to any board, against 128-bit arithmetic",
    "digitizer": "commands, samples, losses to the C digitizer",
    "node": "memory, sync pulses, readings to the C node",
    "board": "commands to the emulated skin's digitizer",
    "kernel": "bytes, levels and words to the driver's compiled kernel",
}
"""The harnesses of firmware/fuzz."""
COUNTS = {  # inputs, quick and full; about 2 s of one core, and 40 s
    "framing": (20_000, 1_000_000),
    "setup": (60_000, 5_000_000),
    "digitizer": (2_000, 150_000),
    "node": (20_000, 1_000_000),
    "board": (2_000, 150_000),
    "kernel": (5_000, 150_000),
}
MOST_S = (2, 40)
"""Time limit of a harness, s; a busy machine runs fewer inputs."""
HANG_S = (20, 30)


def run(plan: Plan) -> Iterator[Outcome]:
    """Run a slice of each harness, then both languages on the same bytes, then storms."""
    kind = best_kind()
    build(f"fuzz-{kind}")
    for name in harnesses():
        yield fuzzed(BUILD / "fuzz" / kind / name, kind, plan)
    build("replay-native")
    replay = BUILD / "replay" / "replay"
    yield same_answers(replay, plan)
    yield same_samples(replay, plan)
    yield from storms(plan)


def fuzzed(program: Path, kind: Kind, plan: Plan) -> Outcome:
    """Run a harness for its slice."""
    name, length = program.name, 0 if plan.quick else 1
    limits = (COUNTS[name][length], plan.seed, MOST_S[length], HANG_S[length])
    return outcome(WHAT[name], kind, fuzz(program, kind, *limits))


def outcome(what: str, kind: Kind, found: Fuzzed) -> Outcome:
    """The row of a harness."""
    return Outcome(
        what,
        found.inputs,
        wrong_values=int(found.fault == "wrong value"),
        uncounted_losses=int(found.fault == "uncounted loss"),
        crashes=int(found.fault == "crash"),
        hangs=int(found.fault == "hang"),
        said=found.said
        or ("libFuzzer" if kind == "libfuzzer" else "no clang: mutants of kept cases"),
    )
