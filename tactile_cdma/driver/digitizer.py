# SPDX-License-Identifier: Apache-2.0

"""What the digitizer says about itself, and whether that agrees with a skin's parameters."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.quiet_limit import quiet_uv
from ..wire._protocol import PacketType, Result, SyncMode
from ..wire.messages import Ack, FrameLayout, Info, Status

MAX_SAMPLES_PER_CHIP = 1000
"""Chosen: 8 suffice for any timing, and buffers of a frame stay small at this many."""


@dataclass(slots=True)
class DigitizerState:
    """What the digitizer has said on the present connection.

    info: its last description of itself, None before the first.
    status: its last STATUS.
    streaming: whether it streams, by its last STATUS or by obeying a START since; None: not known.
    refusal: the last command that it refused and has not obeyed since.
    """

    info: Info | None = None
    status: Status | None = None
    streaming: bool | None = None
    refusal: Ack | None = None

    def hear_status(self, status: Status) -> None:
        """Take in a STATUS."""
        self.status, self.streaming = status, status.streaming

    def hear_ack(self, ack: Ack) -> None:
        """Take in the answer to a command."""
        if ack.result != Result.OK:
            self.refusal = ack
            return
        if ack.command == PacketType.START:
            self.streaming = True
        if self.refusal and self.refusal.command == ack.command:
            self.refusal = None


def contradiction(info: Info, config: SkinConfig) -> str | None:
    """Why this digitizer's stream cannot be decoded with these parameters, or None."""
    if wrong := config.refusal(info.digitizer_id):
        return wrong
    if not (info.volts_per_count > 0 and info.min_count < info.max_count):
        return (
            f"the digitizer describes no voltages: {info.volts_per_count:g} V per count, counts "
            f"{info.min_count} to {info.max_count}"
        )
    samples_per_chip = info.sample_rate_hz * config.spec.chip_s
    if samples_per_chip > MAX_SAMPLES_PER_CHIP:
        return (
            f"the digitizer sends {samples_per_chip:.3g} samples per chip; "
            f"{MAX_SAMPLES_PER_CHIP} at most are taken"
        )
    if info.integrated != (abs(samples_per_chip - 1) < 0.01):
        return (
            f"the digitizer says it sends {'chip means' if info.integrated else 'raw samples'}, "
            f"but {samples_per_chip:.3g} per chip"
        )
    if config.timing != GAP and info.sync_mode == SyncMode.NONE:
        return (
            "the digitizer marks no frame starts but timing is 'line': set timing to 'gap', "
            "or connect the sync wire"
        )
    if config.timing == GAP and info.integrated:
        return "the digitizer sends one mean per chip, timing 'gap' needs raw samples"
    if config.spec.amplitude_v is not None and info.quiet_uv > (most_uv := quiet_uv(config.spec)):
        return (
            f"the digitizer leaves out frames whose samples differ by up to {info.quiet_uv} µV, in "
            f"which nodes may have spoken: {most_uv} µV at most"
        )
    theirs, ours = info.frame, FrameLayout.of(config.spec, config.samples_per_chip)
    # A digitizer may sample faster or slower than asked: its rate is in INFO and is what counts.
    aside = {"samples_per_chip"} | ({"sign_seed"} if ours.natural_signs else set())
    different = [
        f"{field.name} {getattr(theirs, field.name)} (parameters: {getattr(ours, field.name)})"
        for field in fields(FrameLayout)
        if field.name not in aside and getattr(theirs, field.name) != getattr(ours, field.name)
    ]
    if different:
        return f"the digitizer is set to {', '.join(different)}; make the two agree"
    return None
