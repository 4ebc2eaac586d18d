# SPDX-License-Identifier: Apache-2.0

"""Sends recordings of the independent line as a digitizer would: an introduction, then packets."""

from __future__ import annotations

from collections.abc import Iterator

from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.wire._protocol import MAX_SAMPLES
from tactile_cdma.wire.messages import Info, Samples
from tactile_cdma.wire.packets import PacketWriter
from test.support import simulated
from test.support.independent_line import Digitizer, Recording, Skin


def config_of(skin: Skin, digitizer: Digitizer, **more: float) -> SkinConfig:
    """Return what a user sets for such a skin; more: other parameters."""
    values: dict[str, Value] = {
        "nodes": skin.nodes,
        "bits": skin.bits,
        "parity": skin.parity,
        "order": skin.order,
        "first_row": skin.first_row,
        "scramble": skin.scramble,
        "codes": "sparse" if skin.sparse else "orthogonal",
        "sign_seed": -1 if skin.sign_seed is None else skin.sign_seed,
        "chip_us": 1e6 * skin.chip_s,
        "frame_period_ms": 1e3 * skin.chip_s * skin.period_chips,
        "drive": skin.drive,
        "polarity": skin.polarity,
        "amplitude_mv": 1e3 * skin.amplitude_v,
        "timing": "line" if digitizer.marked else "gap",
        "samples_per_chip": 1 if digitizer.integrated else digitizer.samples_per_chip,
        "resync_chips": skin.restart_chips,
        "guard_chips": skin.guard_chips,
    }
    return SkinConfig.of({**values, **more})


def introduction(config: SkinConfig, digitizer: Digitizer) -> Info:
    """Return what the digitizer says about itself."""
    top = 2 ** (digitizer.adc_bits - 1)
    return simulated.introduction(
        config, digitizer.volts_per_count, min_count=-top, max_count=top - 1
    )


def packets(recording: Recording, writer: PacketWriter) -> Iterator[tuple[float, float, bytes]]:
    """Yield the packets of a recording: device time in chips, host time in s, bytes."""
    digitizer, chip_s = recording.digitizer, recording.skin.chip_s
    per_chip = 1 if digitizer.integrated else digitizer.samples_per_chip
    for run in recording.runs:
        for begin in range(0, run.counts.size, MAX_SAMPLES):
            t_chips = run.t_chips + begin / per_chip
            packet = Samples(
                round(1e6 * chip_s * t_chips),
                run.first_index + begin,
                run.counts[begin : begin + MAX_SAMPLES],
                sync=run.marked and not begin,
            )
            yield t_chips, t_chips * chip_s, writer.encode(packet)
