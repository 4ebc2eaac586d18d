# SPDX-License-Identifier: Apache-2.0

"""Makes of a digitizer's INFO what its packets of samples are decoded by."""

import numpy as np

from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.gaps.gap_timing import GapTiming
from ..framing.line_timing import LineTiming
from ..framing.sparse_timing import SparseTiming
from ..wire.messages import Info
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
