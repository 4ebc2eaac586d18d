"""Chips to words: who spoke in this frame, what was said, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .frame import FrameSpec
from .transform import correlate

ACTIVE_SHARE = 0.5
"""A node spoke where the mean of |r| over its word exceeds this share of its amplitude."""
AUTO_FLOOR = 6.0
"""With the amplitude unknown, words below this many noise deviations count as silence."""
LOW_RHO = 5.0
"""Words of lower amplitude/noise are flagged: below it, more than 3e-6 of them hold an error."""
LOW_MARGIN = 0.4
"""Words are flagged where one bit has less than this share of the word's mean amplitude."""


@dataclass(frozen=True, slots=True)
class Words:
    """What n nodes said in one frame.

    active: (n,) bool, False for a silent node (its other entries then mean nothing).
    codes: (n,) int32 ADC words.
    amplitude_v: (n,) float32, V, mean |r| over the word's bits.
    rho: (n,) float32, amplitude over the noise of one correlation (√N·a/σ in the signal model).
    doubtful: (n,) bool, active words whose decision was close in at least one bit.
    noise_rms_v: σ, noise of one chip sample, V.
    """

    active: NDArray[np.bool_]
    codes: NDArray[np.int32]
    amplitude_v: NDArray[np.float32]
    rho: NDArray[np.float32]
    doubtful: NDArray[np.bool_]
    noise_rms_v: float


def silent(spec: FrameSpec, noise_rms_v: float = 0.0) -> Words:
    """The words of a frame in which nobody spoke."""
    nothing = np.zeros(spec.nodes, dtype=np.float32)
    no = np.zeros(spec.nodes, dtype=bool)
    return Words(no, np.zeros(spec.nodes, dtype=np.int32), nothing, nothing, no, noise_rms_v)


def decode(chips: NDArray[np.float32], spec: FrameSpec, threshold: float = ACTIVE_SHARE) -> Words:
    """Separate the nodes of one frame.

    chips: (k, N) float32, V, free of DC if row 0 is assigned. threshold: share of the expected
    amplitude above which a word counts as spoken. Activity is decided per word and not per bit:
    k correlations average out the noise, which takes lost words from 0.32 to 1e-4 at ρ = 4.
    """
    everything = correlate(chips, spec.book)
    values = everything[:, spec.rows] * (spec.signs * spec.polarity)
    level = np.abs(values)
    amplitude = level.mean(axis=0)
    noise = _noise(everything, level, amplitude, spec)
    swing = spec.node_swing_v
    if swing is None:
        swing = max(float(amplitude.max()), AUTO_FLOOR * noise / threshold)
    active = amplitude > threshold * swing
    weights = 1 << np.arange(spec.bits - 1, -1, -1, dtype=np.int32)
    codes = weights @ (values > 0)
    rho = amplitude / max(noise, 1e-12)
    doubtful = active & ((rho < LOW_RHO) | (level.min(axis=0) < LOW_MARGIN * amplitude))
    return Words(
        active,
        np.where(active, codes, 0).astype(np.int32),
        amplitude,
        rho.astype(np.float32),
        doubtful,
        float(noise * np.sqrt(spec.order)),
    )


def _noise(
    everything: NDArray[np.float32],
    level: NDArray[np.float32],
    amplitude: NDArray[np.float32],
    spec: FrameSpec,
) -> float:
    """RMS noise of one correlation, V: from the spare rows, else from the scatter of the words.

    A spoken word's k levels scatter about their mean with the noise. The levels of a silent node
    are the noise itself (folded, so mean and deviation differ by a factor of 1.3 only).
    """
    if len(spec.spare_rows) >= 2:
        return float(np.sqrt(np.mean(np.square(everything[:, spec.spare_rows]))))
    scatter = np.sum(np.square(level - amplitude), axis=0) / (spec.bits - 1)
    spoken = amplitude > 2.2 * np.sqrt(scatter)
    power = np.where(spoken, scatter, np.mean(np.square(level), axis=0))
    return float(np.sqrt(power.mean()))
