# SPDX-License-Identifier: Apache-2.0

"""What the kernel needs to read a frame in which nothing is odd: words and readings in one call."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import kernel
from ..base.arrays import Bools, Floats, Floats32
from ..code.amplitude import (
    FAINT_SHARE,
    LEAST_SHARE,
    LOW_MARGIN,
    MOVED_SHARE,
    hiding_rho,
    most_noise_power,
)
from ..code.frame import FrameSpec
from ..code.separate import frame_fields
from ..words import lateness, limits, tones
from ..words.decode import nobody
from ..words.health import NodeHealth
from .pressure import PressureChain
from .status import Status

ODD, LEFT, FEW, DOUBTFUL = 0, 1, 2, 3
"""As enum readout_look of the kernel."""
_BITS = "silent", "low_snr", "stale", "saturated", "uncalibrated", "masked", "faulty"
"""Of Status, that the kernel sets."""
NOBODY = np.empty(0, np.int32)
"""The kernel's list of those who spoke, where nothing is known of that."""


class Kept(NamedTuple):
    """What is kept of every node, (n,).

    codes: int32, its last word. flags: uint8, LOW_SNR where that is uncertain. heard_s: float64,
    device time of that word, s.
    """

    codes: NDArray[np.int32]
    flags: NDArray[np.uint8]
    heard_s: Floats


class Readout:
    """The kernel's Readout for a skin, and the arrays that it shares with the stages.

    So any frame may be read either way: by it, or by `decode`, NodeHealth and Taxels.update.

    kernel: reads frames; see Taxels.read. nobody: (n,) bool, no node. expected_v: (n,) float32,
    amplitude of each node's words, V; rest: (2, n) float32, V and Pa, and valid: (n,) bool, of the
    last frame, for tare and drift (see Baseline.look); the next one ends them.
    """

    def __init__(
        self,
        spec: FrameSpec,
        active_share: float,
        chain: PressureChain,
        health: NodeHealth,
        kept: Kept,
        flags: NDArray[np.uint8],
        table_v: Floats32,
        masked: Bools,
        source: NDArray[np.int32],
    ) -> None:
        """flags: (n,) status by health. table_v: (codes,) V. masked: (n,) bool.

        active_share: see decode. source: (t,) node of every taxel, or empty.
        """
        assert kernel.compiled is not None
        curves, nodes = chain.calibration.curves, spec.nodes
        self.taxels, self.nobody = len(source) or nodes, nobody(nodes)
        swing_v = health.swing_v
        # Written to where the amplitude is learnt from every frame.
        self.expected_v = np.empty(nodes, np.float32) if swing_v is None else swing_v
        self.rest = np.empty((2, nodes), np.float32)
        self.valid = np.empty(nodes, np.bool_)
        self.kernel = kernel.compiled.Readout(
            kernel.settings(
                "readout_settings",
                **frame_fields(spec),
                **_word_limits(spec, active_share),
                **{bit: Status[bit.upper()] for bit in _BITS},
                codes=len(table_v),
                pieces=len(curves.pieces),
                taxels=self.taxels,
            ),
            spec.sign_mask,
            lateness.offset_rows(spec),
            self.expected_v,
            lateness.edge_rows(spec.book),
            table_v,
            flags,
            health.invalid,
            chain.calibration.uncalibrated,
            masked,
            *chain.bounds,
            curves.pieces,
            source,
            *kept,
            health.sums,
        )


def _word_limits(spec: FrameSpec, active_share: float) -> dict[str, float]:
    """What words are told by: the members of the kernel's words_reading and words_lateness."""
    spare = spec.spare_rows
    return {
        "threshold": active_share,
        "faint_share": FAINT_SHARE,
        "least_squares": spec.line_bits * LEAST_SHARE**2,
        "moved_share": MOVED_SHARE,
        "tone_share": tones.least_left(spec),
        "hiding_rho": hiding_rho(spec.line_bits, 0 if spec.sparse else spec.order),
        "loud_squares": spec.line_bits * most_noise_power(spec.line_bits),
        "sound_share": limits.SOUND_SHARE,
        "most_square": limits.most_square(spec.line_bits),
        "a_chip": lateness.least_left(spec),
        "few": lateness.FEW,
        "few_share": lateness.few_share(spec),
        "parity": spec.parity,
        "low_rho": limits.LOW_RHO,
        "low_margin": LOW_MARGIN,
        "shared": limits.SHARED_SHARE,
        "two": limits.DOUBLE_SHARE,
        "clear_rho": limits.CLEAR_RHO,
        "lower": limits.LOWER_SHARE,
        "late_share": lateness.LATE_SHARE,
        "by_chance": lateness.by_chance_of(spec),
        "of_two": lateness.OF_TWO,
        "scrambled": spec.scramble and not spec.sparse,
        "spare": spare.start,
        "spare_count": spare.stop - spare.start,
    }
