# SPDX-License-Identifier: Apache-2.0

"""Damage between digitizer and driver: bits, bytes and packets lost, changed or reordered.

A man in the middle between a virtual digitizer and a driver on a real tty damages the bytes, one
kind of fault after the other, on many kinds of streams, as fast as the driver reads. It knows what
it did, which shows for each kind whether every word, time and pressure was right, whether the
driver counted losses exactly, and whether it resumed at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from zlib import crc32

import numpy as np

from tactile_cdma.config.parameters import Value

from ..outcome import Outcome, Plan, Tally
from .damage import KINDS, LOST, OF_BYTES, Kind, flipped
from .man_in_the_middle import Counted, Schedule
from .rig import Rig, Stream

ALWAYS = {"threshold": 0}
"""Every node speaks in every frame."""
MANY = {"nodes": 256, "samples_per_chip": 1, "chip_us": 5.0, "frame_period_ms": 20.0}
FEW_SPEAK: dict[str, Value] = {
    **{"codes": "sparse", "nodes": 400, "order": 96, "chip_us": 5.0, "samples_per_chip": 1},
    **{"frame_period_ms": 8.0, "resync_chips": 96, "guard_chips": 20},
}
STREAMS = {
    Stream("chips", {"samples_per_chip": 1}, ALWAYS): 500,
    Stream("samples", {}, ALWAYS): 150,
    Stream("silence", {}, {"scene": "press"}): 150,
    Stream("silent chips", {"samples_per_chip": 1}, {"scene": "presses"}): 400,
    Stream("parity", {"parity": True, "samples_per_chip": 2}, ALWAYS): 80,
    Stream("gaps", {"timing": "gap"}, ALWAYS): 25,
    Stream("silent gaps", {"timing": "gap"}, {"scene": "press"}): 25,
    Stream("256 nodes", MANY, {"scene": "hand"}): 40,
    Stream("sparse", FEW_SPEAK, {"scene": "moving"}): 40,
}
"""The streams, and how many faults of each kind are put into each in a full run."""
QUICK = 2
"""Faults of each kind and stream in a quick run."""
WRAPS = {
    "sequence of packets": Counted(sequence=2**16 - 20),
    "device time, 2^32 µs": Counted(device_time_us=2**32 - 200_000),
    "device time, 200 years": Counted(device_time_us=2**52 + 2**51),
    "index of samples, 2^32": Counted(first_index=2**32 - 5000),
    "index of samples, 2^63": Counted(first_index=2**63 - 5000),
}
WRAP_FAULTS = 12
"""Packets lost while a counter wraps."""
OF_COMMANDS = (Kind("bits", partial(flipped, 1e-2)), *OF_BYTES)
AT_ONCE = 8
"""Drivers run at the same time while commands are damaged: most of it is waiting."""
FRAMES = 5
"""Frames that have to come despite damaged commands."""
COMMANDS = "damaged commands: frames come all the same"


def run(plan: Plan) -> Iterator[Outcome]:
    """One outcome per kind of damage; see the module."""
    yield from harmed(STREAMS, plan)
    for name, begin in WRAPS.items():
        yield wrapped(name, begin, plan)
    yield spoilt_commands(6 if plan.quick else 200, plan)


def harmed(streams: Mapping[Stream, int], plan: Plan) -> Iterator[Outcome]:
    """Put all kinds of damage into these streams, with the number of faults of each."""
    tallies = {kind: Tally() for kind in KINDS}
    for number, (stream, times) in enumerate(streams.items()):
        with Rig(stream, plan.seed + number, patience_s(plan)) as rig:
            for kind in KINDS:
                wanted = times // kind.weight
                if plan.quick:  # slow kinds once, on some streams only
                    wanted = QUICK if kind.weight == 1 else number % kind.weight == 0
                harm(rig, tallies[kind], kind, wanted, [plan.seed, number])
    for kind, tally in tallies.items():
        yield told(kind.name, tally)


def patience_s(plan: Plan) -> float:
    """Time without progress that counts as a hang, s."""
    return 10.0 if plan.quick else 30.0


def told(name: str, tally: Tally) -> Outcome:
    """The row of a kind of damage."""
    said = (
        f"{tally.bytes / 1e3:,.0f} kB hit; {tally.frames:,} frames published, "
        f"{tally.lost:,} lost and counted, {tally.late} whole but unmarked"
    )
    return tally.outcome(name, said)


def harm(rig: Rig, tally: Tally, kind: Kind, times: int, seed: Sequence[int]) -> None:
    """Put faults of a kind into a stream, and add up the findings."""
    schedule = Schedule(kind, times, np.random.default_rng([*seed, crc32(kind.name.encode())]))
    tally += rig.run(schedule)
    tally.times += schedule.done
    tally.bytes += schedule.bytes


def wrapped(name: str, begin: Counted, plan: Plan) -> Outcome:
    """Lose packets while a counter wraps, or is near its end."""
    tally = Tally()
    for number, stream in enumerate(list(STREAMS)[: 2 if plan.quick else None]):
        with Rig(replace(stream, begin=begin), plan.seed + number, patience_s(plan)) as rig:
            harm(rig, tally, LOST, WRAP_FAULTS, [plan.seed, number])
    return told(f"packets dropped near a wrap: {name}", tally)


def spoilt_commands(times: int, plan: Plan) -> Outcome:
    """Damage the host's first commands on their way to the digitizer."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        sessions = [pool.submit(_spoilt, number, plan) for number in range(times)]
        tally = Tally(times)
        for session in sessions:
            tally += session.result()
    return tally.outcome(COMMANDS, f"{tally.frames:,} frames published")


def _spoilt(number: int, plan: Plan) -> Tally:
    """One driver whose first commands are damaged."""
    rng = np.random.default_rng([plan.seed, number])
    kind = OF_COMMANDS[number % len(OF_COMMANDS)]
    stream = list(STREAMS)[number // len(OF_COMMANDS) % len(STREAMS)]
    with Rig(
        stream,
        plan.seed + number,
        patience_s(plan),
        spoil=lambda data: b"".join(kind.damage([data], [data], rng)),
    ) as rig:
        return rig.receive(FRAMES, rng)
