# SPDX-License-Identifier: Apache-2.0

"""The host's side of the conversation with a digitizer. No I/O; see docs/protocol.md."""

from __future__ import annotations

import math

from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.silence import quiet_uv
from ..wire._protocol import SyncMode
from ..wire.messages import (
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    Packet,
    RollCall,
    Start,
    Status,
    Stop,
)
from ..wire.packets import PacketWriter, diagnose
from .pipeline import Pipeline

PATIENCE_S = 1.0
"""A digitizer that says nothing useful for so long is asked again."""
SOON_S, ANSWER_S = 0.1, 0.5
"""One that says that it does not stream is asked again so long after the last time: where it obeyed
that, and where it did not answer, for then its STATUS may have crossed START on the wire."""
MOST_CALLS = 3
"""Roll calls in a row that may come to nothing."""


class Session:
    """The host's side of the start-up handshake: what to send, and what is wrong if nothing comes.

    Where a certain digitizer is asked for, no other one is configured or started. No I/O: bytes to
    send are returned.
    """

    def __init__(self, config: SkinConfig | None = None) -> None:
        """config: how the digitizer is to be set; None leaves it as it is."""
        self.problem: str | None = None
        self._writer = PacketWriter()
        self._setting: tuple[Configure, ...] = ()
        self._config = config
        self._ours = config is None or config.digitizer_id is None
        self._calls_roll = config is not None and config.roll_call
        self._calls_left, self._next_call_s = MOST_CALLS, -math.inf
        if config is not None:
            layout = FrameLayout.of(config.spec, config.samples_per_chip)
            integrated = config.samples_per_chip == 1
            if config.timing == GAP:
                self._setting = (Configure(layout, SyncMode.NONE, integrated),)
            else:
                quiet = quiet_uv(config.spec)
                self._setting = (Configure(layout, SyncMode.DRIVE, integrated, quiet),)
        self._frames = -1
        self._impossible = self._bytes = self._packets = 0
        self._deadline = self._asked_s = -math.inf
        self._obeyed = False
        self._was_idle = False  # no frame came since it was asked again for that
        self._status: Status | None = None  # the last one when it was asked again

    def open(self) -> bytes:
        """Configure (where asked to) and start the digitizer; where it counts, ask who it is."""
        start = (*self._setting, GetInfo(), Start()) if self._ours else (GetInfo(),)
        return self._requests(*start)

    def close(self) -> bytes:
        """Stop the digitizer, if it was started."""
        return self._requests(Stop()) if self._ours else b""

    def introduced(self, info: Info) -> bytes:
        """What to send now that the digitizer has said who it is."""
        known = self._ours
        wrong = self._config.refusal(info.digitizer_id) if self._config is not None else None
        self._ours = wrong is None
        return self.open() if self._ours and not known else b""

    def watch(self, pipeline: Pipeline, now_s: float) -> bytes:
        """Requests that are due: nothing came of the last ones, or it is now known who is there."""
        if self._frames < 0:  # open() was just before
            self._asked_s = now_s
        if pipeline.info is not None and (start := self.introduced(pipeline.info)):
            self._asked(pipeline, now_s)
            return start
        if self._calls_roll and (request := self._roll_call(pipeline, now_s)):
            return request
        if pipeline.counters.frames != self._frames:
            self._was_idle = False
            self._note(pipeline, now_s)
        if now_s >= self._deadline:
            self.problem = self._why(pipeline)
        elif self._is_idle(pipeline, now_s):
            self.problem = self._why(pipeline) if self._was_idle else None
            self._was_idle = True
        else:
            return b""
        self._asked(pipeline, now_s)
        return self.open()

    def _is_idle(self, pipeline: Pipeline, now_s: float) -> bool:
        """Whether a digitizer that was to stream says that it does not: it was reset.

        Every STATUS counts once, so that one which cannot stream is not asked without end.
        """
        self._obeyed = self._obeyed or bool(pipeline.streaming)
        due_s = self._asked_s + (SOON_S if self._obeyed else ANSWER_S)
        news = pipeline.status is not self._status
        return self._ours and news and pipeline.streaming is False and now_s >= due_s

    def _asked(self, pipeline: Pipeline, now_s: float) -> None:
        """The digitizer is asked to stream."""
        self._status, self._asked_s, self._obeyed = pipeline.status, now_s, False
        self._note(pipeline, now_s)

    def _note(self, pipeline: Pipeline, now_s: float) -> None:
        """How far it is, for what comes of it."""
        counters, seen = pipeline.counters, pipeline.parser.counters
        self._frames, self._impossible = counters.frames, counters.implausible_packets
        self._bytes, self._packets = seen.bytes, seen.packets
        self._deadline = self._due_s(pipeline, now_s)

    def _due_s(self, pipeline: Pipeline, now_s: float) -> float:
        """When frames must have come of a request that is sent now."""
        return now_s + max(PATIENCE_S, 3 * pipeline.config.spec.frame_period_s)

    def _roll_call(self, pipeline: Pipeline, now_s: float) -> bytes:
        """The request for a roll call, if there has been none in which all nodes were heard.

        The digitizer may have been reset, or the clocks have changed: then it is time for another.
        """
        clocks = pipeline.clocks
        if clocks is None or clocks.busy:
            return b""
        if clocks.heard == pipeline.config.spec.nodes:
            self._calls_left = MOST_CALLS
        elif self._calls_left and now_s >= self._next_call_s and pipeline.can_call_roll:
            spec = pipeline.config.spec
            self._calls_left -= 1
            self._next_call_s = now_s + PATIENCE_S + 2 * spec.nodes * spec.frame_period_s
            self.problem = None
            return self._requests(RollCall())
        return b""

    def _why(self, pipeline: Pipeline) -> str:
        """The likely cause of having received no frame for a while."""
        if pipeline.problem:
            return pipeline.problem
        counters = pipeline.parser.counters
        if counters.packets and counters.bytes == self._bytes:
            return "the digitizer has fallen silent: is it still powered?"
        if pipeline.refusal:
            command, reason = pipeline.refusal.command, pipeline.refusal.result.name.lower()
            return f"the digitizer refused command 0x{command:02x}: {reason.replace('_', ' ')}"
        if pipeline.info is None:
            return diagnose(counters)
        if counters.packets == self._packets:
            return "bytes arrive, but no packets any more: another device, or another baud rate?"
        if pipeline.counters.implausible_packets > self._impossible + 1:
            return "the digitizer's clock and its count of samples contradict each other"
        if pipeline.rejected:
            return "samples arrive, but no frame fits: check chip_us, order and bits"
        return "the digitizer answers but sends no frames; is the skin connected and powered?"

    def _requests(self, *packets: Packet) -> bytes:
        return b"".join(self._writer.encode(packet) for packet in packets)
