# SPDX-License-Identifier: Apache-2.0

"""Fuzz targets, what counts as a find, and mutated inputs."""

from __future__ import annotations

import random
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from tactile_cdma.base.errors import TactileError

SLOW_S = 1.0
"""Processor time above which an input is a find, s."""
HANG_S = 10.0
"""Processor time after which an input is given up, s."""
MOST_TEXT = 4096
"""Longest text of an error, characters."""
CRASH, SLOW, WRONG, UNCOUNTED = "crash", "slow", "wrong", "uncounted"


@dataclass(frozen=True, slots=True)
class Target:
    """A reader of untrusted bytes.

    run: reads them; raises AssertionError if a promise is broken, MiscountError if a loss is not
    counted. seeds: inputs to start from, by name. refuses: errors by which it may refuse an input.
    most_bytes: largest input.
    """

    name: str
    run: Callable[[bytes], object]
    seeds: Callable[[], Mapping[str, bytes]]
    refuses: tuple[type[TactileError], ...] = ()
    most_bytes: int = 4096


@dataclass(frozen=True, slots=True)
class Find:
    """A defect shown by an input. kind: CRASH, SLOW, …; where: identifies the defect."""

    kind: str
    where: str
    text: str


class MiscountError(AssertionError):
    """A loss that was not counted, or a counted loss that did not happen."""


class _HangError(BaseException):
    """No Exception, so that no target catches it."""


@contextmanager
def trying(target: Target) -> Iterator[Callable[[bytes], Find | None]]:
    """Yield a function that runs the target on data; None: read or properly refused."""
    before = signal.signal(signal.SIGVTALRM, _give_up)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # warnings would be printed on the user's terminal
            yield lambda data: _attempt(target, data)
    finally:
        signal.signal(signal.SIGVTALRM, before)


def _attempt(target: Target, data: bytes) -> Find | None:
    begun_s = time.thread_time()
    try:
        signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S)
        try:
            target.run(data)
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    except target.refuses as error:
        if wrong := _unfit(str(error)):
            return Find(CRASH, f"{_where()} {wrong}", repr(str(error)[:MOST_TEXT]))
    except _HangError:
        return Find(SLOW, _where(), traceback.format_exc())
    except Exception as error:
        where = f"{_where()} {type(error).__name__}"
        return Find(_kind(error), where, traceback.format_exc())
    if (took_s := time.thread_time() - begun_s) > SLOW_S:
        return Find(SLOW, target.name, f"took {took_s:.1f} s of processor time")
    return None


def _kind(error: Exception) -> str:
    if isinstance(error, MiscountError):
        return UNCOUNTED
    return WRONG if isinstance(error, AssertionError) else CRASH


def _unfit(text: str) -> str:
    """Why a text is unfit for a terminal or a log; empty if it is not."""
    if not text:
        return "says nothing"
    if len(text) > MOST_TEXT:
        return "says too much"
    return "" if text.isprintable() else "says control characters"


def _where() -> str:
    """The innermost place in our code in the current traceback."""
    ours = "unknown"
    for frame, line in traceback.walk_tb(sys.exc_info()[2]):
        file = Path(frame.f_code.co_filename)
        if "tactile_cdma" in file.parts or "torture" in file.parts:
            ours = f"{file.name}:{line}"
    return ours


def _give_up(signum: int, frame: FrameType | None) -> None:
    raise _HangError


# ---- inputs that are nearly right, where there is no atheris to make better ones

_TELLING = (b"\0", b"\xff", b"\x80", b"\x7f", b"-", b"9" * 20, b"nan", b"1e999", b"\n", b"[" * 20)
"""Byte sequences that readers tend to fail on."""


def inputs(target: Target, seed: int) -> Iterator[bytes]:
    """Yield the target's seeds, then mutations, endlessly."""
    rng, seeds = random.Random(f"{target.name} {seed}"), list(target.seeds().values())
    yield from (known[: target.most_bytes] for known in seeds)
    while True:
        yield mutated(rng, seeds)[: target.most_bytes]


def mutated(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """One of the seeds after a few changes."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(1, 5)):
        begin = rng.randint(0, len(data))
        end = min(len(data), begin + int(rng.expovariate(0.2)))
        other = rng.choice(seeds)
        cut = rng.randint(0, len(other))
        data[begin:end] = rng.choice(
            (
                b"",
                rng.randbytes(max(1, end - begin)),
                bytes(byte ^ 1 << rng.randrange(8) for byte in data[begin:end]),
                rng.choice(_TELLING),
                other[cut : cut + 1 + int(rng.expovariate(0.05))],
                bytes(data[begin:end]) * 2,
            )
        )
    return bytes(data)
