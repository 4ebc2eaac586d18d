# SPDX-License-Identifier: Apache-2.0

"""Kinds of damage to bytes in transit, as functions of packets and random numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from tactile_cdma.wire.messages import Quiet, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter

Packets: TypeAlias = Sequence[bytes]
Damage: TypeAlias = Callable[[Packets, Packets, np.random.Generator], list[bytes]]
"""Packets with their delimiters, and earlier ones → the bytes that arrive instead, in clumps."""

RUN = 64
"""Largest number of bytes dropped, doubled, moved or inserted at once."""
REPLAYED = 30
"""Largest number of packets repeated in a row."""
LARGEST_BURST = 100_000


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault, applied to at least `packets` packets in a row of at least `size` bytes.

    weight: duration, relative to other kinds. hold_s: pause between clumps, s of the host's time.
    forges: it turns a packet into another valid one.
    """

    name: str
    damage: Damage
    packets: int = 1
    size: int = 1
    weight: int = 1
    hold_s: float = 0.0
    forges: bool = False


def flipped(rate: float, packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Flip every bit with this probability."""
    data = np.frombuffer(b"".join(packets), np.uint8).copy()
    places = np.unique(rng.integers(8 * data.size, size=rng.binomial(8 * data.size, rate)))
    np.bitwise_xor.at(data, places // 8, np.uint8(1) << (places % 8).astype(np.uint8))
    return [data.tobytes()]


def dropped(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Drop a run of bytes."""
    before, _run, after = _cut(b"".join(packets), rng)
    return [before + after]


def doubled(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Repeat a run of bytes."""
    before, run, after = _cut(b"".join(packets), rng)
    return [before + run + run + after]


def shuffled(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Shuffle a run of bytes."""
    before, run, after = _cut(b"".join(packets), rng)
    return [before + bytes(rng.permutation(list(run)).astype(np.uint8)) + after]


def filled(
    value: int | None, packets: Packets, _: Packets, rng: np.random.Generator
) -> list[bytes]:
    """Insert a run of bytes of one value, or random ones (None)."""
    data = b"".join(packets)
    place, size = int(rng.integers(len(data) + 1)), int(rng.integers(1, RUN + 1))
    run = rng.bytes(size) if value is None else bytes([value]) * size
    return [data[:place] + run + data[place:]]


def burst(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Replace bytes by noise, 1 B to 100 kB, which may be more than there was."""
    data = b"".join(packets)
    place = int(rng.integers(len(data)))
    size = int(LARGEST_BURST ** rng.random())
    return [data[:place] + rng.bytes(size) + data[place + size :]]


def in_clumps(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Deliver everything, cut anywhere, with pauses."""
    data = b"".join(packets)
    cuts = [0, *sorted(rng.integers(len(data), size=3).tolist()), len(data)]
    return [data[a:b] for a, b in pairwise(cuts)]


def without_one(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Drop a packet."""
    missing = int(rng.integers(len(packets)))
    return [b"".join(p for number, p in enumerate(packets) if number != missing)]


def one_twice(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Repeat a packet, at once or a little later."""
    first, later = np.sort(rng.integers(len(packets), size=2)).tolist()
    return [b"".join((*packets[: later + 1], packets[first], *packets[later + 1 :]))]


def late(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Deliver a packet after some of its successors."""
    moved = list(packets)
    packet = moved.pop(int(rng.integers(len(packets) - 1)))
    moved.insert(int(rng.integers(1, len(packets))), packet)
    return [b"".join(moved)]


def replayed(packets: Packets, past: Packets, rng: np.random.Generator) -> list[bytes]:
    """Repeat packets of long ago."""
    first = int(rng.integers(len(past)))
    return [b"".join((*past[first : first + int(rng.integers(1, REPLAYED + 1))], *packets))]


def forged(packets: Packets, _: Packets, rng: np.random.Generator) -> list[bytes]:
    """Replace a packet of samples by one with a false index or time; leave others alone.

    Its CRC and sequence are right: only the contents can give it away.
    """
    [packet] = packets
    (said,) = PacketParser().feed(packet)
    if not isinstance(said, Samples | Quiet):
        return [packet]
    places: list[dict[str, int]] = [
        {"first_index": (said.first_index + 2**60) % 2**64},
        {"first_index": said.first_index // 2},
        {"device_time_us": said.device_time_us + 2**45},
        {"device_time_us": 2**64 - 1},
        {"device_time_us": said.device_time_us + 200_000},
        {"first_index": int(rng.integers(2**62)), "device_time_us": int(rng.integers(2**52))},
    ]
    claim = replace(said, **places[int(rng.integers(len(places)))])  # type: ignore[arg-type]
    if rng.random() < 0.2:
        claim = Quiet(said.device_time_us, said.first_index, 2**32 - 1, 0, 0, sync=said.sync)
    return [PacketWriter(said.sequence).encode(claim)]


def _cut(data: bytes, rng: np.random.Generator) -> tuple[bytes, bytes, bytes]:
    """The bytes before, in and after a random run."""
    place = int(rng.integers(len(data)))
    stop = place + int(rng.integers(1, RUN + 1))
    return data[:place], data[place:stop], data[stop:]


_EXPOSED = {6: (200_000, 33), 5: (12_000, 3), 4: (1200, 1), 3: (500, 1), 2: (1, 1)}
"""Negative power of ten of the rate: bytes in which about one bit flips, and weight."""
FLIPS = tuple(
    Kind(f"bits flipped, 1 in 10^{power}", partial(flipped, 10.0**-power), 1, size, weight)
    for power, (size, weight) in _EXPOSED.items()
)
OF_BYTES = (
    Kind("bytes dropped", dropped),
    Kind("bytes doubled", doubled),
    Kind("bytes in another order", shuffled),
    Kind("zeros put in", partial(filled, 0)),
    Kind("ones put in", partial(filled, 0xFF)),
    Kind("random bytes put in", partial(filled, None)),
    Kind("bursts of noise, 1 B to 100 kB", burst),
)
LOST = Kind("packets dropped", without_one)
AGAIN = Kind("old packets once more, up to 30 in a row", replayed)
OF_PACKETS = (
    LOST,
    Kind("packets doubled", one_twice, packets=4),
    Kind("packets in another order", late, packets=4),
    AGAIN,
    Kind("packets with a right CRC and wrong contents", forged, forges=True),
)
HELD = Kind("bytes held back and sent in clumps", in_clumps, packets=3, hold_s=2e-3)
KINDS = (*FLIPS, *OF_BYTES, *OF_PACKETS, HELD)
