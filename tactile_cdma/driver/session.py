# SPDX-License-Identifier: Apache-2.0

"""The host's side of the conversation with a digitizer. No I/O; see docs/protocol.md."""

import math
from typing import NamedTuple

from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..wire._protocol import PacketType, SyncMode, SyncWire
from ..wire.messages import (
    Ask,
    Command,
    Configure,
    FrameLayout,
    GetInfo,
    Groups,
    Info,
    Pack,
    Packet,
    Start,
    Stop,
)
from ..wire.packets import PacketWriter, diagnose
from .digitizer import DigitizerState, Origin, Source, quiet_uv, spoken
from .pipeline import Pipeline

PATIENCE_S = 1.0
"""s without a frame, or 3 frame periods if that is longer, until the digitizer is asked again and
the likely cause is told. Chosen: it sends STATUS and INFO once a second."""
SOON_S, ANSWER_S = 0.1, 0.5
"""s since START until a STATUS that denies streaming is answered by another START: SOON_S where
START was acknowledged, ANSWER_S where it was not, as the STATUS may have crossed it on the wire.
Part of the protocol (docs/protocol.md)."""
PACKED_FROM_HZ = 200_000
"""Samples per second above which packed ones are asked for. Chosen: 0.4 MB/s of words, a third of
what full-speed USB can carry; older digitizers, which refuse, are hardly ever set so."""


class _Progress(NamedTuple):
    """Notes how far decoding was when the digitizer was last asked, or sent a frame."""

    frames: int = -1
    implausible_packets: int = 0
    bytes: int = 0
    packets: int = 0


class Session:
    """Tells what to send to the digitizer, and what is wrong if no frames come.

    If the parameters ask for a certain digitizer, no other one is configured, started or stopped.

    problem: the likely cause of having received no frame; None if none is known.
    deadline_s: when that will be told, if no frame comes before.
    """

    def __init__(self, config: SkinConfig | None = None, stepped: bool = False) -> None:
        """config: how the digitizer is to be set; None leaves it as it is.

        stepped: of a simulated digitizer, whose frames pass as a program asks for them.
        """
        self.problem: str | None = None
        self._config, self._stepped = config, stepped
        self._writer = PacketWriter()
        self._setting = () if config is None else _setting(config)
        self._ours = config is None or config.digitizer_id is None
        self._known: Info | None = None  # the digitizer's last introduction
        self._groups_asked, self._next_groups_s = 0, -math.inf
        self._before = _Progress()
        self.deadline_s = self._asked_s = -math.inf
        self._obeyed = False  # it has streamed since it was asked
        self._was_idle = False  # it denied streaming, and no frame has come since
        self._answered = DigitizerState().status  # the last STATUS when it was asked

    def open(self) -> bytes:
        """Make requests that configure (if asked to) and start the digitizer, or ask who it is."""
        start = (*self._setting, GetInfo(), Start()) if self._ours else (GetInfo(),)
        return self.encoded(*start)

    def close(self) -> bytes:
        """Make the request that stops the digitizer, if it was started."""
        return self.encoded(Stop()) if self._ours else b""

    def introduced(self, info: Info) -> bytes:
        """Take in who the digitizer is; returns what to send if that was awaited."""
        awaited = not self._ours
        self._ours = self._config is None or self._config.refusal(info.digitizer_id) is None
        return self.open() if self._ours and awaited else b""

    def watch(self, pipeline: Pipeline, now_s: float, heard_s: float = math.inf) -> bytes:
        """Make the requests that are due: the last ones failed, or the digitizer is known.

        heard_s: when the last frame was read, or the port opened, if that was before this read.
        """
        if self._before.frames < 0:  # open() was just before
            self._asked_s = now_s
        digitizer = pipeline.digitizer
        if digitizer.info is not self._known:
            self._known = digitizer.info
            if self._known is not None and (start := self.introduced(self._known)):
                self._note_request(pipeline, now_s)
                return start
        if groups := self._groups(pipeline, now_s):
            return groups
        if pipeline.counters.frames != self._before.frames:
            self._was_idle = False
            self._note_progress(pipeline, min(now_s, heard_s))
        if now_s >= self.deadline_s:
            if self._stepped and digitizer.refusal is None:
                return b""  # another START would begin a stream anew
            self.problem = self._why(pipeline)
        else:
            self._obeyed |= bool(digitizer.streaming)
            if not self._is_idle(pipeline, now_s):
                return b""
            self.problem = self._why(pipeline) if self._was_idle else None
            self._was_idle = True
        self._note_request(pipeline, now_s)
        return self.open()

    def _is_idle(self, pipeline: Pipeline, now_s: float) -> bool:
        """Tell whether the digitizer denies streaming, though it had the time to obey START.

        Every STATUS counts once, so that one that cannot stream is not asked without end.
        """
        digitizer = pipeline.digitizer
        due_s = self._asked_s + (SOON_S if self._obeyed else ANSWER_S)
        unanswered = digitizer.status is not self._answered
        return self._ours and unanswered and digitizer.streaming is False and now_s >= due_s

    def _note_request(self, pipeline: Pipeline, now_s: float) -> None:
        self._answered, self._asked_s, self._obeyed = pipeline.digitizer.status, now_s, False
        self._note_progress(pipeline, now_s)

    def _note_progress(self, pipeline: Pipeline, now_s: float) -> None:
        """Wait for the next frame from now on."""
        seen = pipeline.counters
        self._before = _Progress(seen.frames, seen.implausible_packets, *pipeline.parser.received)
        self.deadline_s = now_s + max(PATIENCE_S, 3 * pipeline.config.spec.frame_period_s)

    def _groups(self, pipeline: Pipeline, now_s: float) -> bytes:
        """Make the request to divide the nodes into groups, or to end that, if the load wants it.

        A digitizer that refused it once is not asked again.
        """
        groups, refusal = pipeline.groups, pipeline.digitizer.refusal
        is_refused = refusal is not None and refusal.command == PacketType.GROUPS
        is_obeyed = groups.now_log2 == self._groups_asked
        is_due = is_obeyed or now_s >= self._next_groups_s
        is_due = is_due and groups.wanted_log2 != groups.now_log2
        if self._config is None or not self._ours or not is_due or is_refused:
            return b""
        self._groups_asked, self._next_groups_s = groups.wanted_log2, now_s + ANSWER_S
        return self.encoded(Groups(groups.wanted_log2))

    def ask(self, pipeline: Pipeline, now_s: float) -> bytes:
        """Make the request that all nodes speak, if their values are in doubt and it is due."""
        config, refused = self._config, pipeline.digitizer.ask_refused
        is_marked = config is not None and config.timing != GAP and not pipeline.has_source
        if not (is_marked and self._ours) or refused or not pipeline.asking.request(now_s):
            return b""
        return self.encoded(Ask(pipeline.asking.log2_turns))

    def _why(self, pipeline: Pipeline) -> str:
        """Tell the likely cause of having received no frame for a while."""
        if pipeline.problem:
            return pipeline.problem
        packets, refusal = pipeline.parser.counters, pipeline.digitizer.refusal
        if packets.packets and packets.bytes == self._before.bytes:
            if Source.of_port("", pipeline.digitizer.info).origin == Origin.SIMULATED:
                return "the simulator has fallen silent: does it run, and keep up?"
            return "the digitizer has fallen silent: is it still powered?"
        if refusal:
            reason = spoken(refusal.result)
            return f"the digitizer refused command 0x{refusal.command:02x}: {reason}"
        if pipeline.digitizer.info is None:
            return diagnose(packets)
        if packets.packets == self._before.packets:
            return "bytes arrive, but no packets any more: another device, or another baud rate?"
        if pipeline.counters.implausible_packets > self._before.implausible_packets + 1:
            return "the digitizer's clock and its count of samples contradict each other"
        if pipeline.rejections.total:
            return "samples arrive, but no frame fits: check chip_us, order, bits and scramble"
        return "the digitizer answers but sends no frames; is the skin connected and powered?"

    def encoded(self, *packets: Packet) -> bytes:
        """Encode packets as this conversation numbers them."""
        return b"".join(map(self._writer.encode, packets))


def _setting(config: SkinConfig) -> tuple[Command, ...]:
    layout = FrameLayout.of(config.spec, config.samples_per_chip)
    integrated = config.samples_per_chip == 1
    if config.timing == GAP:
        configure = Configure(layout, SyncMode.NONE, integrated)
    else:
        mode, wire = SyncMode[config.sync.upper()], SyncWire[config.sync_wire.upper()]
        configure = Configure(layout, mode, integrated, quiet_uv(config.spec), wire)
    packs = config.samples_per_chip > PACKED_FROM_HZ * config.spec.chip_s
    return (configure, Pack()) if packs else (configure,)
