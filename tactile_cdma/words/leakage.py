# SPDX-License-Identifier: Apache-2.0

"""Tells a weak node from what its neighbours' chips leave in the rows of silent ones.

Behind a low-pass, a ringing amplifier or late edges a chip holds a share of the chips beside it.
Rows are orthogonal, but not to each other's shifts, and in Paley's orders they nearly are such
shifts: then a loud node shows in a silent one's row, in every bit with the same level.
"""

import math

import numpy as np

from ..base.arrays import Bools, Floats32
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from ..code.transform import chips_of, rows_of

TAPS = (1, -1)
"""Distances, in chips, from which a chip may hold a share: behind a low-pass of the chip before,
where samples are late of the one after. Chosen."""


def unexplained(
    levels: NodeLevels, loud: Bools, faint: Bools, spec: FrameSpec
) -> tuple[Floats32, float]:
    """Levels of all nodes without what leaks from chips of the loud ones, (k, n) float32, V.

    Also the noise of one level, V RMS, without that leakage.

    loud: (n,) bool, nodes whose words are known to have been sent; their levels are returned as
    they are. faint: (n,) bool, nodes in question. One share for each of TAPS, the same for all
    nodes, is fitted by least squares to what all rows hold but those of the nodes in question, and
    but the loud nodes' own amplitudes: leakage that explains a node shows in other rows, too.
    """
    values = levels.values
    signs = np.sign(values) * loud
    symbols = np.zeros((spec.line_bits, spec.row_count), np.float32)
    symbols[:, spec.node_slice] = values - _uneven(values, signs)
    symbols[:, spec.node_slice] *= loud
    chips = chips_of(symbols, spec).ravel()
    beside = np.zeros((len(TAPS), chips.size), np.float32)
    for shifted, tap in zip(beside, TAPS, strict=True):
        if tap > 0:
            shifted[tap:] = chips[:-tap]
        else:
            shifted[:tap] = chips[-tap:]
    rows = rows_of(beside.reshape(len(TAPS), spec.line_bits, spec.order), spec)
    leaked = rows[..., spec.node_slice]
    cause, effect = _uneven(leaked, signs) * ~faint, _uneven(values, signs) * ~faint
    if levels.rows is not None:
        cause = np.concatenate((cause, rows[..., spec.spare_rows]), axis=-1)
        effect = np.concatenate((effect, levels.rows[:, spec.spare_rows]), axis=-1)
    cause, effect = cause.reshape(len(TAPS), -1), effect.ravel()
    share = np.linalg.lstsq(cause @ cause.T, cause @ effect, rcond=None)[0]
    left: Floats32 = values - np.tensordot(share.astype(np.float32), leaked, 1) * ~loud
    free = effect.size - int(faint.sum()) * spec.line_bits - int(loud.sum()) - len(TAPS)
    noise_v = math.sqrt(float(np.square(effect - share @ cause).sum()) / max(free, 1))
    return left, min(noise_v, levels.noise_v)


def _uneven(values: Floats32, signs: Floats32) -> Floats32:
    """What a word of one amplitude with these signs leaves over of (…, k, n) levels."""
    amplitude = (values * signs).mean(axis=-2, keepdims=True)
    uneven: Floats32 = values - amplitude * signs
    return uneven
