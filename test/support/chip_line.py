# SPDX-License-Identifier: Apache-2.0

"""A digitizer that integrates: chips of frames → packets → the driver's frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.framing.frames import LineFrame
from tactile_cdma.wire.messages import Samples
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words.words import Words, silent
from test.support.single_frames import SingleReader

from .simulated import introduction

VOLTS_PER_COUNT = 5e-4


def read_chips(
    chips: ArrayLike, spec: FrameSpec, noise_v: float = 0.0, active_share: float = 0.5
) -> Words:
    """Return the words of one frame's chips (k, N), V, at a line of this noise; it is read."""
    frame = hear(chips, spec, noise_v, active_share)
    assert frame is not None, "rejected"
    return silent(spec.nodes, 0.0) if frame.words is None else frame.words


def hear(
    chips: ArrayLike, spec: FrameSpec, noise_v: float = 0.0, active_share: float = 0.5
) -> LineFrame | None:
    """Return what the kernel reads of one frame's chips, two samples each, in a line at rest.

    None: it is rejected.
    """
    reader = SingleReader(spec, 2 / spec.chip_s, active_share=active_share)
    reader.learn_rest(0.0, noise_v**2)
    levels = np.zeros(spec.span_chips)
    levels[spec.places] = np.asarray(chips).ravel()
    volts = np.concatenate((np.repeat(levels, 2), np.zeros(8)))
    return reader.read(volts.astype(np.float32))


class ChipLine:
    """What the driver makes of frames that are given as chips, one after the other.

    pipeline: the driver's.
    """

    def __init__(self, spec: FrameSpec, **parameters: object) -> None:
        """parameters: other ones of the driver."""
        config = SkinConfig.of({"samples_per_chip": 1, **parameters})
        self.spec, self.pipeline = spec, Pipeline(replace(config, spec=spec))
        self._writer, self._frames = PacketWriter(), 0
        told = introduction(
            self.pipeline.config, VOLTS_PER_COUNT, min_count=-32768, max_count=32767
        )
        self.pipeline.feed(self._writer.encode(told), 0.0)
        assert self.pipeline.problem is None, self.pipeline.problem

    def frame(self, chips: ArrayLike) -> TactileFrame:
        """Send the chips of the next frame, (k, N) V."""
        spec, counts = self.spec, np.rint(np.asarray(chips).ravel() / VOLTS_PER_COUNT)
        begin_us = round(1e6 * spec.frame_period_s * self._frames)
        index = self._frames * spec.chips
        self._frames += 1
        found = []
        for begin in range(0, counts.size, 64):
            part = counts[begin : begin + 64].astype(np.int16)
            at_us = begin_us + round(1e6 * spec.chip_s * begin)
            packet = Samples(at_us, index + begin, part, sync=begin == 0)
            found += self.pipeline.feed(self._writer.encode(packet), 1e-6 * at_us)
        [frame] = found
        return frame
