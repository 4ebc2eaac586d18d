# SPDX-License-Identifier: Apache-2.0

"""A node's EEPROM: what a sensing node has to know about its skin.

The bytes are a NodeRecord (firmware/protocol.yaml), the chips of the node's code row, 1 for +1,
least significant bit first, and the CRC-32 of both. The last chip ends an octet; unused bits of the
first octet repeat the end of the row, as if it were cyclic. The row's sign is in the record, not in
the chips. Of a sparse code, whose chips the node makes from its first octets, these come instead.
"""

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import NodeMemoryError, SpecError, check_limits
from ..code.codes import scrambler_state
from ..code.frame import MEASURING_S, FrameSpec
from ..code.sparse import TAPS, code_digits, code_numbers
from ..config.frame_rate import MCUS
from ..config.parameters import LINE
from ..wire._protocol import (
    FIELDS,
    NODE_LEARN_REST,
    NODE_MAGIC,
    NODE_VERSION,
    NODE_VERSION_DATA,
    TURN_NUMBER_BITS,
    Polarity,
    SyncWire,
)
from ..wire.messages import WIRE, FrameLayout, Message

HEARTBEAT_S = 1.0
"""Default time between two words of a node at rest, s; chosen, below stale_after_s."""
REST, CHANGE = "rest", "change"
"""By which rule a node speaks: in every frame while its code is off its rest, or when that has
changed since it last spoke; by both in its heartbeat, and when everybody is asked."""
FOLLOW_S = 60.0
"""Time in which the rest of a node of 10 bits follows its code by 1 LSB, s; doubled by each LSB
that this is off, beyond the threshold. Derived: at rest 98 Pa/min of the usual curve, more than
drift_pa_per_min. What is n LSB off becomes the rest in 2^(n - 1) to 2^n min: the lightest contact,
10 LSB (1 kPa), in 8.5 hours at least; 5 LSB, by which 2 % a day drifts under a touch of 6 hours,
in half an hour. Of fewer bits, whose LSB are larger, it is 8 times as long for each."""
_OF_LAYOUT = (
    *("nodes", "bits", "parity", "order", "chip_ns", "frame_period_us"),
    *("resync_chips", "guard_chips"),
)
"""Fields of NodeRecord that are those of FrameLayout."""
CRC_BYTES = 4
_VERSION_AT = 4
"""Octets before the version in a memory: the magic."""
CRYSTALS_MHZ = (8, 16)
"""Crystals of a node that has its memory in flash, MHz."""
MOST_IN_FLASH = (1 << TURN_NUMBER_BITS) - 1
"""Memories there: numbers that the digitizer can announce."""
SHOWN_CHIPS = 64
"""Chips of a row that are printed, what fits on a line; chosen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeRecord(Message):
    """The beginning of a node's EEPROM, in the integers stored there.

    node: counted from 1. row: of the code book, or its code number; for whoever reads the memory,
        as the chips follow. digits: of a sparse code, 0 for a row.
    scramble: state of the scrambler before a frame, or 0. rest: code at rest, or NODE_LEARN_REST.
    threshold: LSB. follow, heartbeat, turn: frames; follow is 0 for the rule CHANGE.
    """

    magic: int = NODE_MAGIC
    version: int = NODE_VERSION
    node: int
    nodes: int
    row: int
    digits: int = 0
    sign: Polarity
    bits: int
    parity: bool
    order: int
    chip_ns: int
    frame_period_us: int
    resync_chips: int
    guard_chips: int
    scramble: int
    discipline: bool
    rest: int
    threshold: int
    follow: int
    heartbeat: int
    turn: int

    @property
    def sync_wire(self) -> SyncWire:
        """Return the wire on which the node hears the sync pulses."""
        return SyncWire.DATA if self.version == NODE_VERSION_DATA else SyncWire.OWN


@dataclass(frozen=True, slots=True)
class NodeTable(Message):
    """Before the memories in a node's flash. count: of them. crystal_mhz: 16 is divided by 2."""

    count: int
    crystal_mhz: int


Memory = tuple[NodeRecord, NDArray[np.int8]]
"""Record and chips of a sensor."""


def check_timing(timing: str) -> None:
    """Raises SpecError for a timing with which these nodes never send."""
    if timing != LINE:
        raise SpecError(
            f"timing is {timing!r}: the digitizer then gives no sync pulses, and these nodes talk "
            f"only when they hear one; set timing to {LINE!r}"
        )


def node_memory(
    spec: FrameSpec,
    node: int,
    *,
    threshold: int = 1,
    heartbeat: int | None = None,
    rest: int | None = None,
    discipline: bool = True,
    mcu: str = "atmega328p",
    speaks: str | None = None,
) -> bytes:
    """Make the EEPROM of one node, counted from 1.

    threshold: LSB; the node talks while its code is farther than this from what it sent last, or
        by the rule REST from its rest; 0: always.
    heartbeat: frames; the node talks at least once in so many, the nodes taking turns; 0: never;
        None: as many as usual_heartbeat says.
    rest: code at rest; None: learnt after power-up.
    discipline: chip times follow the period of the sync edges.
    speaks: the rule, REST or CHANGE; None: as usual_follow says.

    Raises SpecError, naming value, limit and cause, for what these nodes cannot do.
    """
    if mcu not in MCUS:
        raise SpecError(f"mcu is {mcu!r}; it must be one of {', '.join(MCUS)}")
    if heartbeat is None:
        heartbeat = usual_heartbeat(spec.frame_period_s)
    most_code, bits = 2**spec.bits - 1, f"codes have {spec.bits} bits"
    check_limits("node", node, 1, spec.nodes, "nodes are counted from 1")
    check_limits("threshold", threshold, 0, most_code, bits)
    check_limits("heartbeat", heartbeat, *_limits("heartbeat"), "a node counts frames in 16 bits")
    check_limits("rest", rest or 0, 0, most_code, bits)
    check_limits("bits", spec.bits, *_limits("bits"), "a node's converter has 10 bits")
    layout = FrameLayout.of(spec, samples_per_chip=1)  # whole nanoseconds and microseconds
    _check_code(mcu, spec)
    _check_chip(layout.chip_ns, mcu, spec)
    _check_restarts(mcu, spec)
    _check_period(layout.frame_period_us, MEASURING_S + MCUS[mcu].busy_s, spec)
    digits = code_digits(spec.nodes, spec.order) if spec.sparse else 0
    record = NodeRecord(
        node=node,
        row=int(code_numbers(digits)[node]) if digits else int(spec.rows[node - 1]),
        digits=digits,
        sign=Polarity(int(spec.signs[node - 1])),
        **{name: getattr(layout, name) for name in _OF_LAYOUT},
        scramble=scrambler_state(spec.sign_seed or 0) if spec.scramble else 0,
        discipline=discipline,
        rest=NODE_LEARN_REST if rest is None else rest,
        threshold=threshold,
        follow=usual_follow(spec, speaks),
        heartbeat=heartbeat,
        turn=(node - 1) * heartbeat // spec.nodes,
    )
    octets = _first_octets(record.row, digits) if digits else _row_octets(record.row, spec)
    return _sealed(record.pack() + octets)


def hearing_data(memory: bytes, mcu: str) -> bytes:
    """Return this memory for a node that hears the sync pulses on the data wire.

    Raises SpecError for nodes that cannot.
    """
    if not MCUS[mcu].hears_data:
        able = ", ".join(name for name, chip in MCUS.items() if chip.hears_data)
        raise SpecError(
            f"sync_wire is data, but an {mcu} hears sync pulses only on a wire of their own: set "
            f"sync_wire to own, or take nodes that can ({able})"
        )
    body = bytearray(memory[:-CRC_BYTES])
    body[_VERSION_AT] = NODE_VERSION_DATA
    return _sealed(bytes(body))


def _sealed(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(CRC_BYTES, "little")


def _row_octets(row: int, spec: FrameSpec) -> bytes:
    """Pack the chips of a row, of which the last one ends an octet."""
    (chips,) = spec.book.rows([row])
    filled = np.take(chips > 0, np.arange(-(-spec.order % 8), spec.order), mode="wrap")
    return np.packbits(filled, bitorder="little").tobytes()


def _first_octets(number: int, digits: int) -> bytes:
    """Return the octets with which a sparse code begins, as many as its register has."""
    for t in range(7 * digits):
        digit = number >> t ^ sum(number >> t + tap for tap in TAPS[digits])
        number |= (digit & 1) << t + digits
    return number.to_bytes(digits, "little")


def _check_code(mcu: str, spec: FrameSpec) -> None:
    board = MCUS[mcu]
    if spec.sparse and not board.sparse_chip_ns:
        raise SpecError(
            f"the {mcu}, with 8 kB of flash, has no sparse codes: take another, or set codes to "
            "orthogonal"
        )
    if spec.sparse and spec.resync_chips and not board.bits_restart:
        raise SpecError(
            f"resync_chips is {spec.resync_chips}, but an {mcu} makes sparse codes without "
            "restarts: set resync_chips and guard_chips to 0"
        )
    if not spec.sparse:
        check_limits("order", spec.order, 1, board.order, f"the {mcu} holds no longer code row")


def _check_restarts(mcu: str, spec: FrameSpec) -> None:
    """Raises SpecError for restarts within the frame that this board does not make, or lacks."""
    board = MCUS[mcu]
    if board.bits_restart and spec.order % 2:
        raise SpecError(
            f"order is {spec.order}, but an {mcu} sends chips in octets, and fills the first "
            "one up in pairs: set order to an even number"
        )
    least_guard = math.ceil(board.restart_s / spec.chip_s - 1e-9)
    if board.bits_restart and spec.resync_chips != spec.order:
        raise SpecError(
            f"resync_chips is {spec.resync_chips}, but an {mcu}, whose chips follow its own clock, "
            f"starts anew at every bit: set resync_chips to {spec.order} and guard_chips to "
            f"{least_guard} or more in the parameter file"
        )
    guard_s = spec.guard_chips * spec.chip_s
    if spec.span_chips > spec.chips and guard_s < board.restart_s * (1 - 1e-9):
        raise SpecError(
            f"guard_chips is {spec.guard_chips}, but to start anew within the frame a node "
            f"takes at least {least_guard} of {spec.chip_s * 1e6:g} µs: set guard_chips to that in "
            "the parameter file"
        )


def _check_period(frame_period_us: int, measuring_s: float, spec: FrameSpec) -> None:
    """Raises SpecError for a period that a node cannot time, or in which it cannot measure."""
    least_ms, most_ms = (limit / 1e3 for limit in _limits("frame_period_us"))
    period_ms = frame_period_us / 1e3
    check_limits("frame_period_ms", period_ms, least_ms, most_ms, "a node times the sync edges")
    gap_s = spec.frame_period_s - spec.frame_s
    if gap_s < measuring_s * (1 - 1e-9):  # rounding of the difference
        raise SpecError(
            f"the gap after a frame lasts {gap_s * 1e3:g} ms, but a node takes "
            f"{measuring_s * 1e3:g} ms to measure in it: frame_period_ms must be at least "
            f"{(spec.frame_s + measuring_s) * 1e3:g}"
        )


def _check_chip(chip_ns: int, mcu: str, spec: FrameSpec) -> None:
    board, reason = MCUS[mcu], f"the {mcu} runs at 8 MHz"
    chip_us = chip_ns / 1e3
    able = [name for name, b in MCUS.items() if b.chip_ns <= chip_ns <= b.longest_chip_ns]
    if able:
        reason += f"; an {able[0]} makes such chips"
    check_limits("chip_us", chip_us, board.chip_ns / 1e3, board.longest_chip_ns / 1e3, reason)
    if spec.sparse and chip_ns < board.sparse_chip_ns:
        raise SpecError(
            f"chip_us is {chip_us:g}; an {mcu} makes sparse codes of chips from "
            f"{board.sparse_chip_ns / 1e3:g} µs on: set codes to orthogonal or use longer chips"
        )
    if spec.scramble and chip_ns < board.scrambled_chip_ns:
        raise SpecError(
            f"chip_us is {chip_us:g}; an {mcu} that scrambles takes "
            f"{board.scrambled_chip_ns / 1e3:g} or more, and {board.chip_ns / 1e3:g} if it does "
            "not: set scramble to false or use longer chips"
        )
    if odd := chip_ns % board.chip_step_ns:
        below_us, step_us = (chip_ns - odd) / 1e3, board.chip_step_ns / 1e3
        raise SpecError(
            f"chip_us is {chip_us:g}; an {mcu} makes chips of whole cycles, in steps of "
            f"{step_us:g} µs: {below_us:g} or {below_us + step_us:g}"
        )


def usual_heartbeat(frame_period_s: float) -> int:
    """Count the frames in about HEARTBEAT_S, one at least: 78 of 12.8 ms."""
    return max(1, round(HEARTBEAT_S / frame_period_s))


def usual_follow(spec: FrameSpec, speaks: str | None = None) -> int:
    """Count the frames in which a node's rest follows by 1 LSB; 0 for the rule CHANGE.

    speaks: the rule; None: CHANGE for sparse codes, of whose nodes only few may speak, else REST.
    """
    if (speaks or (CHANGE if spec.sparse else REST)) == CHANGE:
        return 0
    lsb_s = FOLLOW_S * max(2.0 ** (10 - spec.bits), 8.0 ** (10 - spec.bits))
    frames = round(lsb_s / spec.frame_period_s)
    return min(max(1, frames), _limits("follow")[1])


def read_node_memory(data: bytes) -> Memory:
    """Read the record in an EEPROM and the chips of its row, (order,) int8 of ±1.

    Of a sparse code those that it begins with, (8 · digits,), before they are flipped.
    What follows in the EEPROM is ignored. Raises NodeMemoryError, naming what is wrong.
    """
    if data.count(0xFF) == len(data):
        raise NodeMemoryError("the memory is blank: it was never written, or a chip was erased")
    wire = WIRE["NodeRecord"]
    if len(data) < wire.size:
        raise NodeMemoryError(
            f"{len(data)} bytes are not a node's memory; its record takes {wire.size}"
        )
    values = wire.unpack_from(data)
    found = dict(zip((field.name for field in FIELDS["NodeRecord"]), values, strict=True))
    if found["magic"] != NODE_MAGIC:
        raise NodeMemoryError(
            f"this is not a node's memory: it begins with 0x{found['magic']:08X}, "
            f"not 0x{NODE_MAGIC:08X}"
        )
    if found["version"] not in (NODE_VERSION, NODE_VERSION_DATA):
        raise NodeMemoryError(
            f"the memory has a record of version {found['version']}; known are {NODE_VERSION} "
            f"and {NODE_VERSION_DATA}: write it again"
        )
    size = _size(found["digits"], found["order"])
    if len(data) < size:
        raise NodeMemoryError(
            f"the memory is truncated: a code of {found['order']} chips takes {size} bytes, "
            f"there are {len(data)}"
        )
    body, crc = data[: size - CRC_BYTES], int.from_bytes(data[size - CRC_BYTES : size], "little")
    if zlib.crc32(body) != crc:
        raise NodeMemoryError(
            f"the memory is damaged: CRC-32 is 0x{zlib.crc32(body):08X}, it says 0x{crc:08X}"
        )
    try:
        record = NodeRecord.unpack(body[: wire.size])
    except SpecError as error:
        raise NodeMemoryError(f"the memory is intact, but not for this firmware: {error}") from None
    packed = np.frombuffer(body, np.uint8, offset=wire.size)
    ones = np.unpackbits(packed[: record.digits or _octets(record.order)], bitorder="little")
    if record.digits:
        return record, np.where(ones, -1, 1).astype(np.int8)
    return record, np.where(ones[-record.order :], 1, -1).astype(np.int8)


def read_memories(data: bytes) -> list[Memory]:
    """Read a node's memory, and those of its further sensors, which follow: numbers count on.

    Ends at what is none of them. Raises NodeMemoryError for one that is damaged.
    """
    found = [read_node_memory(data)]
    first = found[0][0]
    size = _size(first.digits, first.order)
    for sensor in range(1, max(board.sensors for board in MCUS.values())):
        rest = data[sensor * size :]
        if rest[:_VERSION_AT] != data[:_VERSION_AT]:
            break
        memory = read_node_memory(rest)
        if memory[0].node != first.node + sensor:
            break
        found.append(memory)
    return found


def describe_memories(memories: Sequence[Memory], table: NodeTable | None = None) -> str:
    """Describe the memories of a node's sensors in a few lines.

    table: that the only one is the first of, in an image.
    """
    (record, chips), *further = memories
    restart = f"every {record.resync_chips} chips, after {record.guard_chips} of pause"
    rest = "learnt after power-up" if record.rest == NODE_LEARN_REST else f"code {record.rest}"
    change = f"more than {record.threshold} LSB from what it sent last"
    if record.follow:
        change += f" or from rest ({rest}), which follows by 1 LSB in {record.follow} frames"
    beat = f"once in {record.heartbeat} frames, first after {record.turn}"
    own = _describe_code(record, chips)
    node, image = f"{record.node} of {record.nodes}", {}
    if further:
        node = f"{record.node} to {further[-1][0].node} of {record.nodes}, a sensor each"
    if table:
        image = {"image": f"program and memory, of a node with {table.crystal_mhz} MHz"}
    if table and table.count > 1:
        image = {"image": f"program and memories, of any node with {table.crystal_mhz} MHz"}
        node = f"1 to {table.count} of {record.nodes}: it takes its number when it is pressed"
        own = f"of node 1 {own}"
        beat = f"once in {record.heartbeat} frames"
    lines = {
        **image,
        "node": node,
        "code": own,
        **{f"… of {other.node}": _describe_code(other, row) for other, row in further},
        "word": f"{record.bits} bits" + (" and parity" if record.parity else ""),
        "chip": f"{record.chip_ns / 1e3:g} µs"
        + (", following the sync edges" if record.discipline else ", of the node's own clock"),
        **({"sync": "pulses on the data wire"} if record.sync_wire else {}),
        "frame": f"every {record.frame_period_us / 1e3:g} ms",
        "scrambler": f"from state 0x{record.scramble:08X}" if record.scramble else "none",
        "restarts": restart if record.resync_chips else "none",
        "talks": change if record.threshold else "in every frame",
        "heartbeat": beat if record.heartbeat else "none",
    }
    return "\n".join(f"{name + ':':<10} {text}" for name, text in lines.items())


def _describe_code(record: NodeRecord, chips: NDArray[np.int8]) -> str:
    """Describe the code of a taxel."""
    code = "".join("+" if chip > 0 else "-" for chip in chips[:SHOWN_CHIPS])
    if chips.size > SHOWN_CHIPS:
        code += f" and {chips.size - SHOWN_CHIPS} more"
    kind = f"sparse, of {record.digits} digits, number" if record.digits else "row"
    return f"{kind} {record.row} of order {record.order}, sign {record.sign:+d}: {code}"


def read_node_table(data: bytes) -> tuple[list[Memory], NodeTable]:
    """Read a table, and of several memories in it the first, else those of the node's sensors.

    All of them are checked. Raises NodeMemoryError, naming what is wrong.
    """
    wire = WIRE["NodeTable"]
    if data[: wire.size].count(0xFF) == wire.size:
        raise NodeMemoryError(
            "this is a program without a node's memory: node --hex joins them, or the EEPROM has it"
        )
    if len(data) < wire.size:
        raise NodeMemoryError("the image is truncated: it ends where its memories begin")
    count, crystal_mhz = wire.unpack_from(data)
    if count not in range(1, MOST_IN_FLASH + 1) or crystal_mhz not in CRYSTALS_MHZ:
        raise NodeMemoryError(f"not a node's image: it says {count} nodes with {crystal_mhz} MHz")
    table, memories = NodeTable(count, crystal_mhz), data[wire.size :]
    if count == 1:
        return read_memories(memories), table
    first = read_node_memory(memories)
    size = _size(first[0].digits, first[0].order)
    for number in range(2, count + 1):
        try:
            node = read_node_memory(memories[(number - 1) * size :])[0].node
        except NodeMemoryError as error:
            raise NodeMemoryError(f"memory {number} of {count}: {error}") from None
        if node != number:
            raise NodeMemoryError(f"memory {number} of {count} is that of node {node}")
    return [first], table


def _size(digits: int, order: int) -> int:
    return WIRE["NodeRecord"].size + (digits or _octets(order)) + CRC_BYTES


def _octets(order: int) -> int:
    return -(-order // 8)


def _limits(name: str) -> tuple[int, int]:
    """Return the smallest and largest value of a record's field."""
    allowed = next(field.allowed for field in FIELDS["NodeRecord"] if field.name == name)
    assert isinstance(allowed, range), "only integers are asked for"
    return allowed[0], allowed[-1]
