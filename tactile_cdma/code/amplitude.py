# SPDX-License-Identifier: Apache-2.0

"""How loud a node is on the line, from the words of a frame; and what is too faint for one."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats32

ACTIVE_SHARE = 0.5
"""A node spoke where the mean of |r| over its word exceeds this share of its amplitude: halfway
between silence and speech."""
FAINT_SHARE = 0.25
"""Share of a node's amplitude below which nothing is taken for a node: half of it may be one, a
quarter is none. Chosen."""
LOUDEST_FLOOR = 0.25
"""Share of the loudest word's amplitude that others have, too, if it is that of a sound node: the
loudest may be that of three nodes on one row, and a lone node then still has a third of it."""


def usual_amplitude(mean: Floats32) -> Floats32:
    """Amplitude of a sound node, V, from mean |r| of all nodes: (…, n) to (…, 1).

    The loudest word may be that of two or three nodes on one row. So it is that of the second of at
    least three loud words.
    """
    loudest: Floats32 = mean.max(axis=-1, keepdims=True)
    if mean.shape[-1] < 3:
        return loudest
    third, second = np.split(np.partition(mean, (-3, -2), axis=-1)[..., -3:-1], 2, axis=-1)
    return np.where(third > np.float32(LOUDEST_FLOOR) * loudest, second, loudest)
