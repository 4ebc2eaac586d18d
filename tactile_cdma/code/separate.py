# SPDX-License-Identifier: Apache-2.0

"""Picks the nodes' levels out of one frame's correlations, and measures their noise."""

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from ..base import kernel
from ..base.arrays import Floats32, Int32s
from ..base.stage import stage
from .amplitude import ACTIVE_SHARE, LOUDEST_FLOOR
from .frame import UNIPOLAR, FrameSpec

SPOKEN_OVER = 2.2
"""Mean |r| over its deviation, above which a word was spoken. Chosen: noise, folded, has 1.3."""


@stage
class NodeLevels:
    """The nodes' levels in one frame.

    values: (k, n) float32, V: correlation of every node's row in every bit; ±a where the node
        spoke, with row signs and the amplifier's polarity applied. A part of rows, if given.
    noise_v: rms noise of one value, V.
    rows: (k, N) float32, V: correlations of all rows; None where only those that spoke are known.
    Of a frame that the kernel decided, both are lent: the stream's next event overwrites them.
    late: nodes, counted from 0, whose words were found in chips that are read early or late.
    level_unknown: row 0 is node 1's, and has a level of one sign that may be the line's offset.
    spoke: (m,) int32, nodes, counted from 0, whose values are not all 0, in any order; None: any.
        Without rows, values are theirs only, (k, m); see whole. Lent, as rows are.
    understood: nearly all words are those that were sent, even if the frame is in doubt.
    """

    values: Floats32
    noise_v: float
    rows: Floats32 | None = None
    late: tuple[int, ...] = ()
    level_unknown: bool = False
    spoke: Int32s | None = None
    understood: bool = False

    def whole(self, spec: FrameSpec) -> "NodeLevels":
        """With the values of all nodes, and rows."""
        if self.spoke is None or self.rows is not None:
            return self
        rows = np.zeros((spec.line_bits, spec.row_count), np.float32)
        rows[:, spec.rows[self.spoke]] = self.values
        return replace(self, values=rows[:, spec.node_slice], rows=rows)


def node_levels(rows: Floats32, spec: FrameSpec, level_known: bool = True) -> NodeLevels:
    """The nodes' share of all correlations, (k, N) float32, V; the spare rows show the noise.

    level_known: that of the line at rest.
    """
    unknown = not level_known and may_be_offset(rows, spec)
    return NodeLevels(
        rows[:, spec.node_slice], noise_of(rows, spec), rows=rows, level_unknown=unknown
    )


def may_be_offset(rows: Floats32, spec: FrameSpec) -> bool:
    """Whether what row 0 holds may be the line's offset, if that is unknown: not if bits change."""
    if spec.first_row > 0 or spec.scramble:
        return False
    return bool(rows[:, 0].min() > 0 or rows[:, 0].max() < 0)


def noise_of(rows: Floats32, spec: FrameSpec) -> float:
    """RMS noise of one correlation, V. rows: (k, N) V, correlations of all rows.

    Where no row is spare: a spoken word's k levels scatter about their mean with the noise; the
    levels of a silent node are the noise itself.
    """
    spare = spec.spare_rows
    frame, count = frame_settings(spec), spare.stop - spare.start
    values = kernel.pointer(np.ascontiguousarray(rows), spec.line_bits, spec.row_count)
    return float(kernel.lib.words_noise(frame, values, spare.start, count))


def frame_fields(spec: FrameSpec) -> dict[str, float]:
    """What the kernel knows of a frame: the members of its struct words_frame."""
    return {
        "bits": spec.line_bits,
        "order": spec.row_count,
        "first": spec.first_row,
        "nodes": spec.nodes,
        "unipolar": spec.drive == UNIPOLAR,
        "swing": math.nan if spec.node_swing_v is None else spec.node_swing_v,
        "loudest_share": LOUDEST_FLOOR,
        "active_share": ACTIVE_SHARE,
        "spoken_over": SPOKEN_OVER,
    }


@lru_cache(maxsize=8)
def frame_settings(spec: FrameSpec) -> Any:
    """The same for its functions."""
    return kernel.struct("words_frame", **frame_fields(spec)).at
