# SPDX-License-Identifier: Apache-2.0

"""Words and readings of a frame in which nothing is odd, in one call of the compiled kernel."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import kernel
from ..base.arrays import Bools, Floats32
from ..code.amplitude import FAINT_SHARE
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels, frame_fields
from ..words import lateness, limits
from ..words.decode import AUTO_FLOOR, Words, nobody
from ..words.health import WEAK_RHO, NodeHealth
from ..words.stages import most_square
from .baseline import Baseline
from .calibration import Calibration
from .stages import Kept, Trust
from .status import Status

_ODD, _LEFT, _DOUBTFUL = 0, 1, 2
"""As enum readout_look of the kernel."""


class Conditions(NamedTuple):
    """What a readout is made for: another one is needed where any of it is another object.

    swing_v, state: see NodeHealth. calibration: of the nodes. threshold: see decode.
    """

    swing_v: Floats32 | None
    state: NDArray[np.uint8]
    calibration: Calibration
    threshold: float


class Read(NamedTuple):
    """One frame; pressure_pa, voltage_v, status: taxel by taxel, see Readings."""

    words: Words
    pressure_pa: Floats32
    voltage_v: Floats32
    status: NDArray[np.uint8]


class Readout:
    """Reads such frames: to the bit as `decode`, NodeHealth.update and Taxels.update do.

    Both keep the same arrays, so that any frame may be read either way.

    conditions: what this one is made for. voltage_v, pressure_pa, valid: (n,), of the last frame
    that was read, for tare and drift (see Baseline.look); the next one ends them.
    """

    def __init__(
        self,
        spec: FrameSpec,
        conditions: Conditions,
        health: NodeHealth,
        kept: Kept,
        trust: Trust,
        table_v: Floats32,
        masked: Bools,
        source: NDArray[np.int32],
    ) -> None:
        """table_v: (codes,) V. masked: (n,) bool. source: (t,) node of every taxel, or empty."""
        assert kernel.compiled is not None
        self.conditions, self._spec = conditions, spec
        curves, nodes = conditions.calibration.curves, spec.nodes
        self._taxels = len(source) or nodes
        swing_v = conditions.swing_v
        # Written to where the amplitude is learnt from every frame.
        self._expected_v = np.empty(nodes, np.float32) if swing_v is None else swing_v
        self._rest = np.empty((2, nodes), np.float32)
        self.voltage_v, self.pressure_pa = self._rest
        self.valid = np.empty(nodes, np.bool_)
        self._kernel = kernel.compiled.Readout(
            kernel.settings(
                "readout_settings",
                **frame_fields(spec),
                **_word_limits(spec, conditions.threshold),
                silent=Status.SILENT,
                low_snr=Status.LOW_SNR,
                stale=Status.STALE,
                saturated=Status.SATURATED,
                uncalibrated=Status.UNCALIBRATED,
                masked=Status.MASKED,
                weak_v=health.weak_v,
                weak_rho=WEAK_RHO,
                codes=len(table_v),
                pieces=len(curves.pieces),
                taxels=self._taxels,
            ),
            spec.sign_mask,
            self._expected_v,
            lateness.edge_rows(spec.book),
            table_v,
            trust.state,
            health.invalid,
            conditions.calibration.uncalibrated,
            masked,
            trust.rest_v,
            curves.pieces,
            curves.end_v,
            source,
            *kept,
            health.sums,
        )

    def read(
        self, levels: NodeLevels, baseline: Baseline, t_device: float, stale_after_s: float
    ) -> Read | None:
        """The words and readings of a frame; None, and nothing is kept, if anything is odd.

        levels: with all rows. t_device: of the frame, s.
        """
        spec, nodes, noise_v = self._spec, self._spec.nodes, levels.noise_v
        active, codes = np.empty(nodes, np.bool_), np.empty(nodes, np.int32)
        floats, doubts = np.empty((3, nodes), np.float32), np.empty((3, nodes), np.bool_)
        readings = np.empty((2, self._taxels), np.float32)
        status = np.empty(self._taxels, np.uint8)
        learnt, in_place = self.conditions.swing_v is None, False
        floor_v = AUTO_FLOOR * noise_v / self.conditions.threshold if learnt else math.nan
        while True:
            look = self._kernel.read(
                levels.rows, 1 / max(noise_v, limits.LEAST_NOISE), floor_v, in_place,
                t_device, stale_after_s, baseline.drift_v, baseline.tare_pa, active, codes, floats,
                doubts, readings, status, self._rest, self.valid,
            )  # fmt: skip
            if look != _LEFT:
                break
            least_v = float(self._expected_v.min())
            if lateness.displaced(levels, floats[0], active, least_v, spec) is not None:
                return None
            in_place = True
        if look == _ODD:
            return None
        no = nobody(nodes)
        doubtful, doubled, odd = doubts if look == _DOUBTFUL else (no, no, no)
        sigma = noise_v * math.sqrt(spec.order)
        amplitude_v, rho, margin = floats
        words = Words(active, codes, amplitude_v, rho, margin, doubtful, doubled, odd, no, sigma)
        pressure_pa, voltage_v = readings
        return Read(words, pressure_pa, voltage_v, status)


def _word_limits(spec: FrameSpec, threshold: float) -> dict[str, float]:
    """What words are told by: the members of the kernel's words_reading and words_lateness."""
    spare = spec.spare_rows
    return {
        "threshold": threshold,
        "faint_share": FAINT_SHARE,
        "sound_share": limits.SOUND_SHARE,
        "most_square": most_square(spec.line_bits),
        "a_chip": lateness.least_left(spec),
        "few": lateness.FEW,
        "few_share": lateness.FEW_SHARE,
        "parity": spec.parity,
        "low_rho": limits.LOW_RHO,
        "low_margin": limits.LOW_MARGIN,
        "shared": limits.SHARED_SHARE,
        "two": limits.DOUBLE_SHARE,
        "clear_rho": limits.CLEAR_RHO,
        "lower": limits.LOWER_SHARE,
        "late_share": lateness.LATE_SHARE,
        "leaked": lateness.LEAKED,
        "by_chance": lateness.BY_CHANCE,
        "scrambled": spec.scramble,
        "spare": spare.start,
        "spare_count": spare.stop - spare.start,
    }
