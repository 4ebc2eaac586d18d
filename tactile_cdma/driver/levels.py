# SPDX-License-Identifier: Apache-2.0

"""Packets of samples → levels of the nodes, for a digitizer that is set as its INFO says."""

from __future__ import annotations

import numpy as np

from ..clocks.clock_keeper import ClockKeeper
from ..clocks.node_timing import NodeTiming
from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.gap_timing import GapTiming
from ..framing.line_timing import LineTiming
from ..framing.marked_timing import MarkedTiming
from ..framing.timing import FrameLevels, QuietBlock, SampleBlock
from ..wire.messages import Info, Samples
from ..wire.packets import PacketParser
from .steady import SteadyStream, can_follow
from .timeline import Pace, Place, Step


class LevelDecoder:
    """Converts counts to volts and finds the frames in them.

    timing: finds the frames. pace: what the digitizer's packets may claim.
    """

    def __init__(self, info: Info, config: SkinConfig, background: bool) -> None:
        """background: see ClockKeeper. Raises SpecError for a sampling that cannot be decoded."""
        self._info = info
        spec, rate_hz = config.spec, info.sample_rate_hz
        low_v, high_v = info.volts(np.array([info.min_count, info.max_count], dtype=np.int16))
        rails_v = float(low_v), float(high_v)
        self.pace = Pace(info, spec)
        self.timing: LineTiming | NodeTiming | GapTiming
        if config.timing == GAP:
            self.timing = GapTiming(spec, rate_hz, rails_v)
        elif info.integrated or spec.resync_chips:
            self.timing = LineTiming(spec, rate_hz, rails_v)
        else:
            self.timing = NodeTiming(spec, rate_hz, rails_v, background)

    @property
    def clocks(self) -> ClockKeeper | None:
        """Clocks of the nodes, where these may have their own."""
        return self.timing.clocks if isinstance(self.timing, NodeTiming) else None

    def steady(self, parser: PacketParser) -> SteadyStream | None:
        """What follows the stream where nothing has to be decided, if the kernel can."""
        timing = self.timing
        if not (parser.is_compiled and isinstance(timing, MarkedTiming) and can_follow(timing)):
            return None
        return SteadyStream(self._info, timing, self.pace, parser)

    @property
    def can_call_roll(self) -> bool:
        """Whether a roll call can be evaluated: frames are marked and raw, the rest is known."""
        return isinstance(self.timing, NodeTiming) and self.timing.line.level_known

    def feed(self, place: Place) -> list[FrameLevels]:
        """The frames that a packet completes."""
        if place.step is not Step.CONTINUES:
            self.timing.reset()
        info, packet = self._info, place.packet
        marks = packet.sync, packet.called
        if isinstance(packet, Samples):
            volts = info.volts(packet.counts)
            return self.timing.feed(SampleBlock(place.index, volts, *marks))
        mean_v = (packet.mean - info.zero_count) * info.volts_per_count
        variance_v2 = packet.variance * info.volts_per_count**2
        return self.timing.quiet(QuietBlock(place.index, packet.count, mean_v, variance_v2, *marks))
