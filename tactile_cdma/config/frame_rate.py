# SPDX-License-Identifier: Apache-2.0

"""Chooses the chips that give a frame rate, for nodes that can make them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from ..base.errors import SpecError
from ..code.frame import MAX_STRETCH, MEASURING_S, FrameSpec
from ..wire._protocol import TAIL_CHIPS
from .parameters import (
    ANY,
    DATA,
    DEFAULTS,
    GAP,
    KINDS,
    REPLAY,
    SIMULATION,
    SLOW,
    TINY,
    Value,
    Values,
)
from .parameters import FAST as QUICK
from .parameters import FOUR as QUAD


@dataclass(frozen=True, slots=True)
class Mcu:
    """A microcontroller for nodes with an image, and the limits of both.

    part: avrdude's name. order: longest code row that fits its memories. chip_ns, longest_chip_ns:
    range of chips that it keeps up with, ns. scrambled_chip_ns: shortest chip that it flips, ns;
    sparse_chip_ns: of a sparse code; 0: it has none. chip_step_ns: chips are a multiple of this.
    flash_table: whether its flash can hold memories. hears_own, hears_data: whether it hears sync
    pulses on a wire of their own, on the data wire. bits_restart: it starts anew at every bit.
    sensors: of a node, each with a row of its own. busy_s: by how much longer it takes to measure.
    restart_s: least guard before a restart within the frame, s: the restart's sync pulse, 64 µs
    ahead of it, must not begin before a node has released the line.
    """

    part: str
    order: int
    chip_ns: int
    scrambled_chip_ns: int
    sparse_chip_ns: int
    longest_chip_ns: int = 1_000_000
    chip_step_ns: int = 1
    bits_restart: bool = False
    restart_s: float = 96e-6
    flash_table: bool = True
    hears_own: bool = True
    hears_data: bool = False
    sensors: int = 1
    busy_s: float = 0.0


FAST, FOUR, TINY_ON_DATA = "atmega328p-fast", "atmega328p-four", "attiny85-data"
"""Images beside those that bear the names of their microcontrollers."""
MCUS = {
    "atmega328p": Mcu("m328p", 4096, 35_000, 35_000, 35_000, hears_data=True),
    FAST: Mcu("m328p", 4096, 500, 1750, 2000, 16_000, 250, bits_restart=True, restart_s=80e-6),
    FOUR: Mcu("m328p", 1024, 43_000, 43_000, 0, hears_data=True, sensors=4, busy_s=800e-6),
    "attiny85": Mcu("t85", 1024, 40_000, 40_000, 0, flash_table=False),
    TINY_ON_DATA: Mcu(
        *("t85", 1024, 40_000, 40_000, 0), flash_table=False, hears_own=False, hears_data=True
    ),
}
HEARS_DATA_NS = min(board.chip_ns for board in MCUS.values() if board.hears_data)
"""Shortest chip of nodes that hear sync pulses on the data wire, ns."""
MCU_OF = {TINY: "attiny85", QUAD: FOUR, SLOW: "atmega328p", QUICK: FAST}
"""The microcontroller of each kind of nodes, the slower ones first."""
SAMPLE_NS = 2000
"""Time of a sample of the RP2040's converter, ns (data sheet: 500 kS/s): no chip is shorter."""
STEP_NS = 100
"""Chips of slower nodes are chosen in steps of this, ns. Chosen: a number that one can read."""
LONG_S, USUAL_HZ = 0.05, 50.0
"""A frame that lasts longer, s, is warned of, with the chips that give this rate. Chosen: the usual
rate of a slow control loop, and two and a half of its periods."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames of a kind of nodes with chips of one duration. room_s: their least period."""

    kind: str
    spec: FrameSpec
    room_s: float

    @property
    def fastest_hz(self) -> float:
        """The rate at which nothing is left between frames but the time to measure."""
        return 1 / self.room_s


def frames_of(spec: FrameSpec, kind: str, stretch: float = 0.0) -> Iterator[Frames]:
    """Yield the frames that nodes of a kind can make, from the longest chips to the shortest.

    spec: of any chips. stretch: share by which frames may last longer. Chips are no longer than by
    default, as samples of longer ones tell no more, and come later.
    """
    board = MCUS[MCU_OF[kind]]
    least_ns = board.sparse_chip_ns if spec.sparse else board.chip_ns
    holds = spec.sparse or spec.order <= board.order
    if not (least_ns and holds) or (board.bits_restart and spec.order % 2):
        return
    least_ns = max(SAMPLE_NS, least_ns, board.scrambled_chip_ns * spec.scramble)
    step_ns = max(STEP_NS, board.chip_step_ns)
    longest_ns = min(board.longest_chip_ns, round(DEFAULTS["chip_us"] * 1e3))
    for chip_ns in range(longest_ns - longest_ns % step_ns, least_ns - 1, -step_ns):
        made = replace(spec, chip_s=chip_ns / 1e9, frame_period_s=math.inf)
        if board.bits_restart:
            guard_chips = math.ceil(board.restart_s * 1e9 / chip_ns - 1e-9)
            made = replace(made, resync_chips=spec.order, guard_chips=guard_chips)
        gap_s = max(MEASURING_S + board.busy_s, TAIL_CHIPS * made.chip_s)
        yield Frames(kind, made, made.frame_s * (1 + stretch) + gap_s)


def mcu_of(kind: str, wire: str) -> str:
    """Name the image of a kind of nodes that hear sync pulses on this wire, if there is one."""
    return TINY_ON_DATA if (kind, wire) == (TINY, DATA) else MCU_OF.get(kind, MCU_OF[SLOW])


def chosen(spec: FrameSpec, get: Values) -> tuple[dict[str, Value], str]:
    """Return the parameters that give the rate that get asks for, and tell what they are.

    spec: of these values, but for chips and period. Raises SpecError where no such nodes do.
    """
    rate_hz, kind = get["rate_hz"], get["node_kind"]
    stretch = MAX_STRETCH if get["timing"] == GAP else 0.0
    kinds: tuple[str, ...] = (kind,)
    if kind == ANY:
        kinds = KINDS[1:]  # tiny nodes do nothing that slow ones do not
    if get["sync_wire"] == DATA:
        kinds = tuple(one for one in kinds if MCUS[mcu_of(one, DATA)].hears_data)
        if not kinds:
            raise SpecError(
                f"sync_wire is 'data', but {MCU_OF[kind]} hears sync pulses only on a wire of "
                "their own: set sync_wire to 'own', or node_kind otherwise"
            )
    able = [[*frames_of(spec, one, stretch)] for one in kinds]
    period_s = math.floor(1e6 / rate_hz) / 1e6
    fitting = (made for frames in able for made in frames if made.room_s <= period_s + 1e-9)
    if (found := next(fitting, None)) is None:
        raise SpecError(f"rate_hz is {rate_hz:g}: {_refusal(spec, kind, able)}")
    chip_us = found.spec.chip_s * 1e6
    values: dict[str, Value] = {
        "chip_us": round(chip_us, 3),
        "frame_period_ms": period_s * 1e3,
        "resync_chips": found.spec.resync_chips,
        "guard_chips": found.spec.guard_chips,
        "samples_per_chip": get["samples_per_chip"],
        "node_kind": found.kind,
    }
    if chip_us * 1e3 < SAMPLE_NS * get["samples_per_chip"]:
        values["samples_per_chip"] = 1  # a mean: the converter takes no more
    said = ", ".join(f"{name} {value}" for name, value in values.items())
    text = f"rate_hz {rate_hz:g}: {said} ({mcu_of(found.kind, get['sync_wire'])})"
    if get["port"] and not get["port"].startswith((SIMULATION, REPLAY)):
        text += "; nodes with other records: write these anew (tactile-cdma node --all)"
    return values, text


def _refusal(spec: FrameSpec, kind: str, able: list[list[Frames]]) -> str:
    """Tell what nodes can do at best."""
    fastest = max((each[-1] for each in able if each), key=lambda f: f.fastest_hz, default=None)
    whose = "no node" if kind == ANY else f"no {kind} node"
    frame = f"a frame of {spec.nodes} nodes ({spec.line_bits} bits × {spec.order} chips)"
    if fastest is None:
        return f"{whose} holds the code of {frame}: set node_kind or codes otherwise"
    at_most = math.floor(fastest.fastest_hz * 10) / 10
    return (
        f"{whose} sends {frame} faster than {at_most:g} Hz, with chips of "
        f"{fastest.spec.chip_s * 1e6:g} µs: set rate_hz to that"
        + ("" if kind in (ANY, QUICK) else f", or node_kind to {QUICK}")
    )


def slow_warning(spec: FrameSpec) -> str | None:
    """Warn of a frame that lasts long, and name chips that would not."""
    if spec.frame_s <= LONG_S:
        return None
    usual_us = math.floor((1 / USUAL_HZ - MEASURING_S) / spec.span_chips * 1e8) / 100
    return (
        f"a frame lasts {spec.frame_s * 1e3:.0f} ms: with chip_us {usual_us:g} there would be "
        f"{USUAL_HZ:g} a second; rate_hz chooses chips that nodes can make"
    )
