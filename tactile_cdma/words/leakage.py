# SPDX-License-Identifier: Apache-2.0

"""Tells a weak node from what its neighbours' chips leave in the rows of silent ones.

Behind a low-pass, a ringing amplifier or late edges a chip holds a share of the chips beside it.
Rows are orthogonal, but not to each other's shifts, and in Paley's orders they nearly are such
shifts: then a loud node shows in a silent one's row, in every bit with the same level.
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Bools, Floats32
from ..code.frame import FrameSpec
from ..code.transform import correlate, spread

TAPS = (1, 2, -1)
"""Distances, in chips, from which a chip may hold a share: of a low-pass and of ringing the chips
before, of late sampling the one after. Chosen."""


def unexplained(values: Floats32, loud: Bools, spec: FrameSpec) -> Floats32:
    """Levels of the other nodes without what leaks from chips of the loud ones, (k, n) float32, V.

    values: (k, n) V, levels of all nodes. loud: (n,) whose words are known to have been sent. One
    share for each of TAPS, the same for all nodes, is fitted by least squares; the loud nodes'
    levels are returned as they are.
    """
    symbols = np.zeros((spec.line_bits, spec.order), np.float32)
    amplitude = np.abs(values).mean(axis=0) * loud
    symbols[:, spec.node_slice] = np.sign(values) * amplitude
    chips = spread(symbols, spec.book).ravel()
    beside = np.zeros((len(TAPS), chips.size), np.float32)
    for shifted, tap in zip(beside, TAPS, strict=True):
        if tap > 0:
            shifted[tap:] = chips[:-tap]
        else:
            shifted[:tap] = chips[-tap:]
    rows = correlate(beside.reshape(len(TAPS), *symbols.shape), spec.book)
    leaked = (rows[..., spec.node_slice] * ~loud).reshape(len(TAPS), -1)
    others = (values * ~loud).ravel()
    share = np.linalg.lstsq(leaked @ leaked.T, leaked @ others, rcond=None)[0]
    left: Floats32 = values - (share.astype(np.float32) @ leaked).reshape(values.shape)
    return left
