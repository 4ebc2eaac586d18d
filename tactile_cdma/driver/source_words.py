# SPDX-License-Identifier: Apache-2.0

"""A source's codes as words: heard without noise, or in doubt where a taxel has no reading."""

import numpy as np

from ..code.frame import FrameSpec
from ..wire.identity import NO_READING
from ..wire.messages import Samples
from ..words.words import Words, nobody

UNKNOWN_V = 1.0
"""Amplitude of words where none is stated, V. Any will do: that of all nodes is the same."""


def source_words(packet: Samples, spec: FrameSpec) -> Words:
    """Make the words of a source's packet of one frame."""
    active, no = packet.counts != NO_READING, nobody(spec.nodes)
    ones = np.ones(spec.nodes, np.float32)
    return Words(
        active=active,
        codes=np.where(active, packet.counts, 0).astype(np.int32),
        amplitude_v=ones * np.float32(spec.node_swing_v or UNKNOWN_V),
        rho=np.full(spec.nodes, np.inf, np.float32),
        margin=ones,
        doubtful=~active,
        doubled=no,
        odd=no,
        faint=no,
        noise_rms_v=float("nan"),
    )
