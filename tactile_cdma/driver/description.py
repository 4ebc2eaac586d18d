# SPDX-License-Identifier: Apache-2.0

"""What a digitizer's INFO says about decoding its packets of samples."""

from __future__ import annotations

import math

import numpy as np

from ..base import kernel
from ..code.twins import MOST_LATE
from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.frame_reader import FrameReader
from ..framing.gaps.gap_timing import SIDE_CHIPS, GapTiming
from ..framing.proposals import Proposer
from ..wire.messages import Info
from ..words.limits import GAP_WEIGHT, LEAST_REST, MOST_RISE
from .timeline import CLOCK_SLACK_S, CLOCK_TOLERANCE, MAX_DEVICE_TIME_US, Pace

ABSURD_V = 1e6
"""Level that no digitizer reports, V: such samples are treated like NaN."""
LEAST_RISE = 1e-3
"""Share of a quarter of a node's amplitude, RMS, that noise may have, however little it was."""
MOST_WAITS = 64
"""Frames that are read after a search in vain until the next one: half a second at 128 Hz."""
MOST_STRETCHED = 1.12
"""Nominal durations that a frame of the longest chips lasts: MAX_STRETCH and its error."""


class Description:
    """How samples are to be understood, for a digitizer that is set as its INFO says.

    reader: reads the frames. gaps: finds them where they are not marked, else None. proposer:
    searches for the timing of marked ones. pace: what the digitizer's packets may claim.
    """

    def __init__(self, info: Info, config: SkinConfig, swing_v: float | None) -> None:
        """Raise SpecError for a sampling that cannot be decoded.

        swing_v: amplitude of a node's row, V; None: unknown.
        """
        self.info, self.spec = info, config.spec
        spec, rate_hz = config.spec, info.sample_rate_hz
        low_v, high_v = info.volts(np.array([info.min_count, info.max_count], dtype=np.int16))
        rails_v = float(low_v), float(high_v)
        self.pace = Pace(info, spec)
        is_marked = config.timing != GAP
        side_chips = MOST_LATE if is_marked else SIDE_CHIPS
        self.reader = FrameReader(spec, rate_hz, rails_v, config.active_share, swing_v, side_chips)
        self.proposer = Proposer(self.reader)
        self.gaps = None if is_marked else GapTiming(self.reader, rate_hz)

    def rules(self, frames: bool) -> kernel.Held:
        """Return the kernel's struct stream_rules; frames: see Pipeline."""
        info, spec, pace, chip = self.info, self.spec, self.pace, self.reader.chip
        gap_size = math.ceil(spec.order * chip)
        pause_s = spec.frame_period_s - MOST_STRETCHED * spec.frame_s
        marked = frames and self.gaps is None
        return kernel.struct(
            "stream_rules",
            marked=marked,
            in_blocks=frames and not marked,
            zero_count=info.zero_count,
            volts_per_count=info.volts_per_count,
            most_volts=ABSURD_V,
            gap_size=gap_size,
            sure_gap=min(gap_size, max(0, int(pause_s / spec.chip_s * chip))),
            least_rest=LEAST_REST,
            gap_weight=GAP_WEIGHT,
            rise=MOST_RISE,
            rise_v2=(LEAST_RISE * 0.25 * (spec.node_swing_v or 0.0)) ** 2,
            most_waits=MOST_WAITS,
            rate_hz=pace.rate_hz,
            slack_s=CLOCK_SLACK_S,
            slack=CLOCK_TOLERANCE,
            gap_s=pace.gap_s,
            gaps=pace.gaps,
            least_gap_s=pace.least_gap_s,
            most_device_us=MAX_DEVICE_TIME_US,
            most_quiet=pace.longest_quiet,
            most_quiet_v2=pace.most_quiet_v2,
        )
