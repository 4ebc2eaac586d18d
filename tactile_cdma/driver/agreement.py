# SPDX-License-Identifier: Apache-2.0

"""Whether a digitizer, as its INFO describes it, and the parameters of a skin agree."""

from __future__ import annotations

from dataclasses import fields

from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.silence import quiet_uv
from ..wire._protocol import SyncMode
from ..wire.messages import FrameLayout, Info

MAX_SAMPLES_PER_CHIP = 1000


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
