# SPDX-License-Identifier: Apache-2.0

"""What one frame's correlations say of every node, and how noisy they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .frame import FrameSpec
from .transform import correlate


@dataclass(frozen=True, slots=True)
class NodeLevels:
    """The nodes of one frame, taken apart.

    values: (k, n) float32, V: correlation of every node's row in every bit; ±a where the node
        spoke. Row signs and the amplifier's polarity are still in it.
    noise_v: rms noise of one value, V.
    unresolved: nodes, counted from 0, whose waveforms do not tell them from some other.
    """

    values: NDArray[np.float32]
    noise_v: float
    unresolved: tuple[int, ...] = ()


def separate(chips: NDArray[np.float32], spec: FrameSpec) -> NodeLevels:
    """Take the nodes of one frame apart by correlation.

    chips: (k, N) float32, V, free of DC if row 0 is assigned.
    """
    return node_levels(correlate(chips, spec.book), spec)


def node_levels(rows: NDArray[np.float32], spec: FrameSpec) -> NodeLevels:
    """The nodes' share of all correlations, (k, N) float32, V; the spare rows show the noise."""
    values = rows[:, spec.node_slice]
    spare = rows[:, spec.spare_rows]
    if spare.shape[1] >= 2:
        return NodeLevels(values, float(np.sqrt(np.einsum("kr,kr->", spare, spare) / spare.size)))
    return NodeLevels(values, _noise_of_words(values))


def _noise_of_words(values: NDArray[np.float32]) -> float:
    """RMS noise of one correlation, V, where no row is spare.

    A spoken word's k levels scatter about their mean with the noise. The levels of a silent node
    are the noise itself (folded, so mean and deviation differ by a factor of 1.3 only).
    """
    level = np.abs(values)
    amplitude = level.mean(axis=0)
    scatter = np.sum(np.square(level - amplitude), axis=0) / (len(values) - 1)
    spoken = amplitude > 2.2 * np.sqrt(scatter)
    power = np.where(spoken, scatter, np.mean(np.square(level), axis=0))
    return float(np.sqrt(power.mean()))
