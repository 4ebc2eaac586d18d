# SPDX-License-Identifier: Apache-2.0

"""Compares what a digitizer says about itself with the parameters, and with what it was before."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Self

import numpy as np

from ..code.frame import FrameSpec
from ..config.parameters import GAP, HEARS, REPLAY, SIMULATION
from ..config.skin_config import SkinConfig
from ..wire._protocol import PacketType, Result, Signs, SyncMode, SyncWire
from ..wire.identity import UNSCALED, is_demonstrator, is_simulated, is_source_id, shown_id
from ..wire.messages import Ack, FrameLayout, Info, Status

MAX_SAMPLES_PER_CHIP = 1000
"""Most samples per chip. Chosen: 8 suffice for any timing, and buffers stay small at this many."""
MAX_FRAME_SAMPLES = 1 << 26
"""Most samples of a frame. Chosen: half a gigabyte as float64; the kernel takes twice as many."""
HEARD_SHARE = 0.135
"""Share of a node's amplitude from which on a faint word is no silence. Chosen: words at 0.15 A are
to be heard, and a tenth is for rounding of counts."""


class Origin(IntEnum):
    """Says where readings come from; values are those of TactileSkinInfo's constants."""

    UNKNOWN = 0
    BOARD = 1
    SIMULATED = 2
    REPLAYED = 3
    DEMONSTRATOR = 4


@dataclass(frozen=True, slots=True)
class Source:
    """A port, or a recording, and the digitizer that is heard there.

    port: URL, or path of a file that is decoded. recorded: it is a recording.
    digitizer_id: 8 bytes; None until the digitizer has introduced itself.
    """

    port: str
    recorded: bool = False
    digitizer_id: bytes | None = None

    @classmethod
    def of_port(cls, url: str, info: Info | None = None) -> Self:
        """Make the source of a port and of what its digitizer has said of itself, if anything."""
        digitizer_id = info.digitizer_id if info else None
        return cls(url, url.lower().startswith(REPLAY), digitizer_id)

    @property
    def measured_by(self) -> Origin:
        """Return BOARD, SIMULATED or DEMONSTRATOR, as it was when recorded; at first UNKNOWN."""
        if self.digitizer_id is None:
            return Origin.UNKNOWN
        if is_demonstrator(self.digitizer_id):
            return Origin.DEMONSTRATOR
        return Origin.SIMULATED if is_simulated(self.digitizer_id) else Origin.BOARD

    @property
    def origin(self) -> Origin:
        """Return REPLAYED for a recording, else measured_by."""
        return Origin.REPLAYED if self.recorded else self.measured_by

    @property
    def digitizer(self) -> str:
        if self.digitizer_id is None:
            return "unknown"
        return f"{self.measured_by.name.lower()}, {shown_id(self.digitizer_id)}"

    def __str__(self) -> str:
        return f"replayed from {self.port}: {self.digitizer}" if self.recorded else self.digitizer


class SourceWatch:
    """Follows which digitizer is on a port, over all connections.

    port: as it was given. source: as it is known now. changes: how often another digitizer took the
    place of one.
    """

    def __init__(self, port: str) -> None:
        """port: URL as the user gave it; empty where none was given, which is the simulator."""
        self.port = port
        self.source = Source.of_port(port or SIMULATION)
        self.changes = 0
        self._exchange: str | None = None

    @property
    def unasked(self) -> str | None:
        """Warn while readings are made up and nobody asked for that; else None."""
        if self.source.origin == Origin.DEMONSTRATOR:
            return (
                f"the readings are made up: the board at {self.source.port} is a demonstrator, "
                "whose nodes have no sensors"
            )
        asked = self.port.lower().startswith(SIMULATION)
        if asked or self.source.origin != Origin.SIMULATED:
            return None
        if self.port:
            return (
                f"the readings are simulated: {self.source.port} leads to a simulator or an "
                "emulator, not to a board"
            )
        return (
            "the readings are simulated, because no port is given: set port to the digitizer's "
            f"(tactile-cdma ports lists them), or to {SIMULATION} to ask for a simulation"
        )

    def hear(self, info: Info) -> list[str] | None:
        """Take in a digitizer's description: None if it is the one known, else new warnings."""
        before, found = self.source.digitizer_id, info.digitizer_id
        if found == before:
            return None
        self.source = replace(self.source, digitizer_id=found)
        warnings = [self.unasked] if self.unasked else []
        if before is not None:
            self.changes += 1
            self._exchange = (
                f"another digitizer is on {self.source.port}: {shown_id(found)}, before "
                f"{shown_id(before)}; calibration and tare may be those of another skin. Set "
                "digitizer_id to accept only one board"
            )
            warnings.append(self._exchange)
        return warnings

    def take_exchange(self) -> str | None:
        """Warn of another digitizer, once for each; else None."""
        exchange, self._exchange = self._exchange, None
        return exchange


@dataclass(slots=True)
class DigitizerState:
    """Holds what the digitizer has said on the present connection.

    info: its last description of itself, None before the first.
    status: its last STATUS.
    streaming: whether it streams, by its last STATUS or by obeying a START since; None: not known.
    refusal: the last command that it refused and has not obeyed since.
    ask_refused: why it refused to ask all nodes to speak, since it was started; None: it did not.
    """

    info: Info | None = None
    status: Status | None = None
    streaming: bool | None = None
    refusal: Ack | None = None
    ask_refused: Result | None = None

    def blinds(self, status: Status) -> bool:
        """Tell whether pulses on the data wire did not show on it since the last STATUS."""
        before = self.status.sync_faults if self.status else 0
        on_data = self.info is not None and self.info.sync_wire == SyncWire.DATA
        return on_data and status.sync_faults > before

    def hear_ack(self, ack: Ack) -> None:
        """Take in the answer to a command; a digitizer need know neither PACK nor ASK."""
        if ack.command == PacketType.PACK:
            return
        if ack.command == PacketType.ASK:
            self.ask_refused = ack.result or None
            return
        if ack.result != Result.OK:
            self.refusal = ack
            return
        if ack.command == PacketType.START:
            self.streaming, self.ask_refused = True, None
        if self.refusal and self.refusal.command == ack.command:
            self.refusal = None


def spoken(result: Result) -> str:
    """Name the answer to a command in words."""
    return result.name.lower().replace("_", " ")


def sync_trouble(info: Info, level_v: float) -> str | None:
    """Tell why sync pulses are missing, if these are not its own. level_v: of the line at rest.

    At rest it is in the middle of the converter's range, pulled low at one of its ends.
    """
    if info.sync_mode == SyncMode.HEAR:
        return (
            "the frames of another digitizer are not heard: is its GPIO16 joined with this one's "
            "GPIO17, does it run, with the same frame_period_ms?"
        )
    if info.sync_wire == SyncWire.OWN:
        return None
    low_v, high_v = info.volts(np.array([info.min_count, info.max_count], dtype=np.int16))
    if abs(level_v - (low_v + high_v) / 2) > (high_v - low_v) / 4:
        return (
            f"the line is stuck at {level_v:.2f} V, where no node is heard: look for a short, a "
            "transistor that stays on, and a node that holds the line"
        )
    return (
        "sync pulses do not pull the line low: is the transistor at GPIO16 connected, is another "
        "digitizer on this line, does this one keep up (samples_per_chip)?"
    )


def contradiction(info: Info, config: SkinConfig) -> str | None:
    """Tell why this digitizer's stream cannot be decoded with these parameters, or None."""
    if wrong := config.refusal(info.digitizer_id):
        return wrong
    if is_source_id(info.digitizer_id):
        return _other_source(info, config)
    wrongs = (text for is_wrong, text in _contradictions(info, config) if is_wrong)
    return next(wrongs, None) or _difference(info, config)


def _other_source(info: Info, config: SkinConfig) -> str | None:
    """Tell why a source's codes are not those of the parameters, or None."""
    for name in ("nodes", "bits"):
        their, our = getattr(info.frame, name), getattr(config.spec, name)
        if their != our:
            return f"the source has {name} {their} (parameters: {our}); make the two agree"
    scale_v = info.volts_per_count * (1 << info.frame.bits)
    if info.volts_per_count == UNSCALED or math.isclose(scale_v, config.adc.vref_v, rel_tol=1e-3):
        return None
    return f"the source has volts of {scale_v:g} V full scale: set vref_v to that"


def _contradictions(info: Info, config: SkinConfig) -> Iterator[tuple[bool, str]]:
    """Yield what may prevent decoding: whether it does, and what to say of it."""
    spec, by_gaps = config.spec, config.timing == GAP
    yield (
        not (info.volts_per_count > 0 and info.min_count < info.max_count),
        f"the digitizer describes no voltages: {info.volts_per_count:g} V per count, counts "
        f"{info.min_count} to {info.max_count}",
    )
    per_chip = info.sample_rate_hz * spec.chip_s
    yield (
        per_chip > MAX_SAMPLES_PER_CHIP,
        f"the digitizer sends {per_chip:.3g} samples per chip; {MAX_SAMPLES_PER_CHIP} at most are "
        "taken",
    )
    samples = per_chip * spec.span_chips
    yield (
        samples > MAX_FRAME_SAMPLES,
        f"a frame has {samples:.3g} samples, {per_chip:.3g} per chip; {MAX_FRAME_SAMPLES:,} at "
        "most are taken: have the digitizer send fewer",
    )
    yield (
        info.integrated != (abs(per_chip - 1) < 0.01),
        f"the digitizer says it sends {'chip means' if info.integrated else 'raw samples'}, but "
        f"{per_chip:.3g} per chip",
    )
    remedy = "" if spec.sparse else "set timing to 'gap', or "
    yield (
        not by_gaps and info.sync_mode == SyncMode.NONE,
        f"the digitizer marks no frame starts but timing is 'line': {remedy}connect the sync wire",
    )
    yield (
        not by_gaps and config.sync == HEARS and info.sync_mode != SyncMode.HEAR,
        "the digitizer follows no other one's frames, but sync is 'hear': set it to 'drive', or "
        "give the board newer firmware",
    )
    their_wire = info.sync_wire.name.lower()
    yield (
        not by_gaps and their_wire != config.sync_wire,
        f"the digitizer has sync_wire {their_wire} (parameters: {config.sync_wire}); make the two "
        "agree, and the nodes' records (tactile-cdma node); older firmware has 'own' only",
    )
    yield (
        by_gaps and info.integrated,
        "the digitizer sends one mean per chip, timing 'gap' needs raw samples",
    )
    most_uv = math.inf if spec.amplitude_v is None else quiet_uv(spec)
    yield (
        info.quiet_uv > most_uv,
        f"the digitizer leaves out frames whose samples differ by up to {info.quiet_uv} µV, in "
        f"which nodes may have spoken: {most_uv} µV at most",
    )


def _difference(info: Info, config: SkinConfig) -> str | None:
    """Tell where the digitizer's layout of a frame is not that of the parameters, or None."""
    theirs, ours = info.frame, FrameLayout.of(config.spec, config.samples_per_chip)
    # A digitizer may sample faster or slower than asked: its rate is in INFO and is what counts.
    aside = {"samples_per_chip"} | ({"sign_seed"} if ours.signs == Signs.NATURAL else set())
    both = {f.name: (getattr(theirs, f.name), getattr(ours, f.name)) for f in fields(ours)}
    different = [
        f"{_shown(name, their)} (parameters: {_shown(name, our).removeprefix(f'{name} ')})"
        for name, (their, our) in both.items()
        if name not in aside and their != our
    ]
    if different:
        return f"the digitizer is set to {', '.join(different)}; make the two agree"
    return None


def quiet_uv(spec: FrameSpec) -> int:
    """Return the largest difference of two samples of a frame that is certainly silent, µV.

    0 where no frame is: with the amplitude unknown, or with row 0 assigned, whose node may
    hold one level for a whole frame.

    Samples within Q of each other have chips within Q. These have a variance of at most (Q/2)²
    (Popoviciu), and a correlation with any row but 0 of at most Q/2, whatever the line's offset:
    a row has as many chips of either sign. A flipped row has not, but a level that lasts for a
    frame is no word of flipped rows. Both lie below what a faint word has. The samples need not
    reach to the frame's end: a node that speaks is heard in the first bit.
    """
    if spec.node_swing_v is None or spec.first_row == 0:
        return 0
    return min(int(HEARD_SHARE * 2e6 * spec.node_swing_v), 2**32 - 1)


_SIGNS = {
    Signs.SEEDED: "scramble false",
    Signs.NATURAL: "sign_seed -1",
    Signs.SCRAMBLED: "scramble true",
    Signs.SPARSE: "codes sparse",
}
"""The parameter that makes a layout have such signs."""


def _shown(name: str, value: object) -> str:
    """Show a field of a layout and its value in the words of the parameters."""
    if isinstance(value, Signs):
        return _SIGNS[value]
    return f"{name} {value.name.lower() if isinstance(value, IntEnum) else value}"
