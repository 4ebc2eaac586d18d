# SPDX-License-Identifier: Apache-2.0

"""Makes of a digitizer's INFO what its packets of samples are decoded by."""

import numpy as np

from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.gaps.gap_timing import GapTiming
from ..framing.line_timing import LineTiming
from ..framing.sparse_timing import SparseTiming
from ..framing.timing import QuietBlock, SampleBlock
from ..wire.messages import Info, Quiet, Samples
from .timeline import Pace


class Description:
    """Decodes the samples of a digitizer that is set as its INFO says.

    timing: finds the frames. pace: what the digitizer's packets may claim.
    """

    def __init__(self, info: Info, config: SkinConfig) -> None:
        """Raises SpecError for a sampling that cannot be decoded."""
        self.info, self.spec = info, config.spec
        spec, rate_hz = config.spec, info.sample_rate_hz
        low_v, high_v = info.volts(np.array([info.min_count, info.max_count], dtype=np.int16))
        rails_v = float(low_v), float(high_v)
        self.pace = Pace(info, spec)
        self.timing: LineTiming | SparseTiming | GapTiming
        if config.timing == GAP:
            self.timing = GapTiming(spec, rate_hz, rails_v)
        elif spec.sparse:
            self.timing = SparseTiming(spec, rate_hz, rails_v)
        else:
            self.timing = LineTiming(spec, rate_hz, rails_v)

    def block(self, index: int, packet: Samples | Quiet) -> SampleBlock | QuietBlock:
        """Convert a packet to volts. index: of its first sample in the stream."""
        info, marks = self.info, (packet.sync, packet.turn)
        if isinstance(packet, Samples):
            return SampleBlock(index, info.volts(packet.counts), *marks)
        mean_v = (packet.mean - info.zero_count) * info.volts_per_count
        variance_v2 = packet.variance * info.volts_per_count**2
        return QuietBlock(index, packet.count, mean_v, variance_v2, *marks)
