# SPDX-License-Identifier: Apache-2.0

"""Inputs that are nearly right, at once, or where there is no atheris to make better ones."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence

from .target import Target

_TELLING = (b"\0", b"\xff", b"\x80", b"\x7f", b"-", b"9" * 20, b"nan", b"1e999", b"\n", b"[" * 20)
"""Bytes that readers stumble over."""


def inputs(target: Target, seed: int) -> Iterator[bytes]:
    """Endlessly, the target's seeds first."""
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
