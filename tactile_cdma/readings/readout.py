# SPDX-License-Identifier: Apache-2.0

"""What the kernel needs to read a frame in which nothing is odd: words and readings in one call."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import kernel
from ..base.arrays import Bools, Floats, Floats32
from ..code.amplitude import (
    FAINT_SHARE,
    LEAST_NOISE,
    LEAST_SHARE,
    LOW_MARGIN,
    MOVED_SHARE,
    hiding_rho,
    most_noise_power,
)
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels, frame_fields
from ..words import lateness, limits, tones
from ..words.decode import nobody
from ..words.health import NodeHealth
from .baseline import Baseline
from .pressure import PressureChain
from .status import Status

ODD, LEFT, FEW, DOUBTFUL = 0, 1, 2, 3
"""As enum readout_look of the kernel."""
_BITS = "silent", "low_snr", "stale", "saturated", "uncalibrated", "masked", "faulty"
"""Of Status, that the kernel sets."""


class Kept(NamedTuple):
    """What is kept of every node, (n,).

    codes: int32, its last word. flags: uint8, LOW_SNR where that is uncertain. heard_s: float64,
    device time of that word, s.
    """

    codes: NDArray[np.int32]
    flags: NDArray[np.uint8]
    heard_s: Floats


class Frame(NamedTuple):
    """Holds what the kernel reads of a frame: of n nodes, and of t taxels.

    words: (3, n) float32, amplitude, V, ρ and margin. flags: (4, n) bool, active nodes, and
    doubtful, doubled and odd words. readings: (2, t) float32, pressure, Pa, and voltage, V. codes:
    (n,) int32. status: (t,) uint8.
    """

    words: Floats32
    flags: Bools
    readings: Floats32
    codes: NDArray[np.int32]
    status: NDArray[np.uint8]


class Readout(kernel.Held):
    """Keeps the kernel's struct readout for a skin, and the arrays that it shares with the stages.

    So any frame may be read either way: by it, or by `decode`, NodeHealth and Taxels.update.

    nobody: (n,) bool, no node. expected_v: (n,) float32, amplitude of each node's words, V; rest:
    (2, n) float32, V and Pa, and valid: (n,) bool, of the last frame, for tare and drift (see
    Baseline.look); the next one ends them.
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
        curves, nodes = chain.calibration.curves, spec.nodes
        self.taxels, self.nobody = len(source) or nodes, nobody(nodes)
        swing_v = health.swing_v
        # Written to where the amplitude is learnt from every frame.
        self.expected_v = np.empty(nodes, np.float32) if swing_v is None else swing_v
        self.rest = np.empty((2, nodes), np.float32)
        self.valid = np.empty(nodes, np.bool_)
        pointer, bits, order = kernel.pointer, spec.line_bits, spec.row_count
        settings = kernel.struct(
            "readout_settings",
            **frame_fields(spec),
            **_word_limits(spec, active_share),
            **{bit: Status[bit.upper()] for bit in _BITS},
            codes=len(table_v),
            pieces=len(curves.pieces),
            taxels=self.taxels,
        )
        offset = lateness.offset_rows(spec)
        by_node: dict[str, NDArray[Any]] = {
            "expected": self.expected_v,
            "state": flags,
            "invalid": health.invalid,
            "uncalibrated": chain.calibration.uncalibrated,
            "masked": masked,
            **dict(zip(("sign", "rest_v", "margin_v", "end_v"), chain.bounds, strict=True)),
            "kept_codes": kept.codes,
            "kept_flags": kept.flags,
            "heard_s": kept.heard_s,
        }
        skin = kernel.struct(
            "readout_skin",
            **{name: pointer(values, nodes) for name, values in by_node.items()},
            sign_mask=pointer(spec.sign_mask, nodes),
            offset=pointer(offset, bits * order) if offset.size else kernel.ffi.NULL,
            edges=pointer(lateness.edge_rows(spec.book), 4, order),
            table_v=pointer(table_v, len(table_v)),
            pieces=pointer(curves.pieces, len(curves.pieces), 3, nodes),
            source=pointer(source, len(source)) if len(source) else kernel.ffi.NULL,
            sums=pointer(health.sums, 5, nodes),
        )
        made = kernel.lib.readout_new(settings.at, skin.at)
        super().__init__(made, kernel.lib.readout_free, settings, skin)
        self._bits, self._order, self._nodes = bits, order, nodes
        words, about = np.empty((3, nodes), np.float32), np.empty((4, nodes), np.bool_)
        readings, codes = np.empty((2, self.taxels), np.float32), np.empty(nodes, np.int32)
        self._found = Frame(words, about, readings, codes, np.empty(self.taxels, np.uint8))
        members = (
            *("amplitude", "rho", "margin"),
            *("active", "doubtful", "doubled", "odd"),
            *("pressure_pa", "voltage_v"),
            *("node_v", "node_pa"),
        )
        self._frame = kernel.struct(
            "readout_frame",
            **dict(zip(members, (*words, *about, *readings, *self.rest), strict=True)),
            codes=codes,
            status=self._found.status,
            valid=self.valid,
        )
        self._read_from: tuple[Any, ...] = (None,) * 3  # arrays, and what points to them
        self._pointers: tuple[Any, ...] = ()

    def read(
        self,
        levels: NodeLevels,
        floor_v: float,
        in_place: bool,
        now_s: float,
        stale_after_s: float,
        baseline: Baseline,
    ) -> int:
        """Read a frame, which `found` gives then: ODD … or more, see enum readout_look.

        floor_v: least usual amplitude; NaN where that is known. in_place: whether what words leave
        over is not to be looked at. now_s: device time of the frame.
        """
        rows, drift_v, tare_pa = levels.rows, baseline.drift_v, baseline.tare_pa
        spoke, speakers, pointer = kernel.ffi.NULL, 0, kernel.pointer
        if rows is None:
            assert levels.spoke is not None
            rows, speakers = levels.values, len(levels.spoke)
            spoke = pointer(levels.spoke, speakers)
        before = self._read_from
        if rows is not before[0] or drift_v is not before[1] or tare_pa is not before[2]:
            self._read_from = rows, drift_v, tare_pa
            shape = self._bits, self._order if levels.rows is not None else speakers
            of_nodes = pointer(drift_v, self._nodes), pointer(tare_pa, self._nodes)
            self._pointers = pointer(rows, *shape), *of_nodes
        of_rows, drift, tare = self._pointers
        per_noise = 1 / max(levels.noise_v, LEAST_NOISE)
        look: int = kernel.lib.readout_read(
            self.at, of_rows, spoke, speakers, per_noise, floor_v, in_place, now_s,
            stale_after_s, drift, tare, self._frame.at,
        )  # fmt: skip
        return look

    def found(self) -> Frame:
        """Return the frame that was read last."""
        words, flags, readings, codes, status = self._found
        return Frame(words.copy(), flags.copy(), readings.copy(), codes.copy(), status.copy())


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
