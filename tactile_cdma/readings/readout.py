# SPDX-License-Identifier: Apache-2.0

"""Binds the kernel's readout (kernel/readout.h): words of a frame → readings, in one call."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import kernel
from ..base.arrays import Bools, Floats, Floats32
from ..framing.frames import words_memory, words_of
from ..words.health import WEAK_RHO, NodeHealth
from ..words.limits import LIMITS
from ..words.words import Words
from .pressure import PressureChain
from .status import Status

_BITS = "silent", "low_snr", "stale", "saturated", "uncalibrated", "masked", "faulty"
"""Flags of Status that the kernel sets."""
_OF_WORDS = "active", "doubtful", "doubled", "odd", "faint", "codes", "amplitude_v", "rho", "margin"
"""Fields of Words that the kernel reads."""


class Kept(NamedTuple):
    """What is kept of every node, (n,).

    codes: int32, its last word. flags: uint8, LOW_SNR where that is uncertain. heard_s: float64,
    device time of that word, s.
    """

    codes: NDArray[np.int32]
    flags: NDArray[np.uint8]
    heard_s: Floats


class Found(NamedTuple):
    """The readings of the last frame, of t taxels; the next one ends them.

    readings: (2, t) float32, pressure, Pa, and voltage, V. status: (t,) uint8.
    """

    readings: Floats32
    status: NDArray[np.uint8]


class Readout(kernel.Held):
    """The kernel's struct readout for a skin, and the arrays that it shares with the stages.

    found: of the last frame. rest: (2, n) float32, V and Pa, and valid: (n,) bool, of the last
    frame, for tare and drift (see Baseline.look); the next one ends them.
    """

    def __init__(
        self,
        chain: PressureChain,
        health: NodeHealth,
        kept: Kept,
        flags: NDArray[np.uint8],
        table_v: Floats32,
        masked: Bools,
        source: NDArray[np.int32],
    ) -> None:
        """flags: (n,) status by health. table_v: (codes,) V. masked: (n,) bool.

        source: (t,) node of every taxel, or empty.
        """
        curves, nodes, pointer = chain.calibration.curves, len(masked), kernel.pointer
        taxels = len(source) or nodes
        self.rest = np.empty((2, nodes), np.float32)
        self.valid = np.empty(nodes, np.bool_)
        settings = kernel.struct(
            "readout_settings",
            **{bit: Status[bit.upper()] for bit in _BITS},
            nodes=nodes,
            codes=len(table_v),
            pieces=len(curves.pieces),
            taxels=taxels,
            low_rho=LIMITS.low_rho,
            low_margin=LIMITS.low_margin,
            weak=health.weak_v,
            weak_rho=WEAK_RHO,
        )
        by_node = {
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
            table_v=pointer(table_v, len(table_v)),
            pieces=pointer(curves.pieces, len(curves.pieces), 3, nodes),
            source=pointer(source, len(source)) if len(source) else kernel.ffi.NULL,
            sums=pointer(health.sums, *health.sums.shape),
        )
        made = kernel.lib.readout_new(settings.at, skin.at)
        super().__init__(made, kernel.lib.readout_free, settings, skin)
        self._memory, self._nodes = words_memory(nodes), nodes
        given = words_of(self._memory, nodes, 0.0)
        self._given = [(name, getattr(given, name)) for name in _OF_WORDS]
        where = pointer(self._memory, self._memory.size)
        self._words = kernel.ffi.new("struct words *", kernel.lib.words_in(where, nodes))
        self.found = Found(np.empty((2, taxels), np.float32), np.empty(taxels, np.uint8))
        self._frame = kernel.struct(
            "readout_frame",
            pressure_pa=self.found.readings[0],
            voltage_v=self.found.readings[1],
            status=self.found.status,
            node_v=self.rest[0],
            node_pa=self.rest[1],
            valid=self.valid,
        )
        self._chain = chain
        self._of_baseline: tuple[Floats32, Floats32] = (np.empty(0, np.float32),) * 2
        self._pointers: tuple[object, ...] = ()

    def read(
        self, words: Words | NDArray[np.uint8], counts: bool, now_s: float, stale_after_s: float
    ) -> None:
        """Read a frame, whose readings are in `found` then.

        words: its words, or the memory in which the kernel wrote them. counts: they say something
        of their nodes. now_s: device time of the frame.
        """
        if isinstance(words, Words):
            for name, given in self._given:
                given[:] = getattr(words, name)
        else:
            self._memory[:] = words
        drift_v, tare_pa = self._chain.baseline.drift_v, self._chain.baseline.tare_pa
        if drift_v is not self._of_baseline[0] or tare_pa is not self._of_baseline[1]:
            self._of_baseline = drift_v, tare_pa
            self._pointers = tuple(kernel.pointer(one, self._nodes) for one in self._of_baseline)
        kernel.lib.readout_read(
            self.at, self._words, counts, now_s, stale_after_s, *self._pointers, self._frame.at
        )
