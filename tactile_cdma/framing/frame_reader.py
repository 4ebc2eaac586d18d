# SPDX-License-Identifier: Apache-2.0

"""Binds the kernel's frame reader (kernel/frame_reader.h): samples of one frame → LineFrame."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from ..base import kernel
from ..base.arrays import Floats, Floats32
from ..base.errors import SpecError
from ..code.frame import BIPOLAR, MAX_STRETCH, UNIPOLAR, FrameSpec
from ..code.transform import Transform
from ..code.twins import MOST_LATE, TWIN, twins
from ..wire._protocol import TAIL_CHIPS
from ..words.limits import LIMITS
from .frames import LineFrame, line_frame, words_memory
from .sparse import SPARSE_LIMITS, sparse_code

REACH = 0.5
REACHES = np.array([REACH, REACH, REACH / 2, REACH / 4])
"""Part of a chip on either side of an edge in which samples tell how late it comes: first as wide
as an edge may be off, and again for those that were farther off, last as narrow as edges a tenth of
a chip off ideal allow."""
BLUR = 0.3
"""Samples around an edge of which it is uncertain on which side of it they were taken: a sample
counts in full beyond 0.15 samples from an edge."""
SETTLED_CHIPS = 0.02
"""Change of a frame's edges, chips, below which refinement ends: 1e-3 of the words' power."""
CHIP_ERROR = 0.01
"""Share by which chips may be shorter than nominal, or longer than the longest stretch: a third of
a chip at the end of a frame of 32."""
BLIND_RHO = 2.5
"""ρ below which words are not found, so that their absence says nothing: at ρ = 3 one frame in
5,000 is missed at order 20 (make bench-error)."""
CLIPPED = 0.5
DEAFENED = CLIPPED / 2
"""Share of samples at a rail at which a line rests there, half of its chips being clipped; and at
which a lone node has half of its amplitude, where silence begins, halved."""
KEPT, REFINED, SEARCHED, MISFIT = 0.67, 3e-3, LIMITS.left, 0.5
"""Shares of the chips' power: that samples may have besides (nodes half a chip late have as much
again); that a carried timing may leave before it is refined (edges 0.04 chip off); with which other
timings are searched for, as the certificate allows no lone node more; and that words may leave."""
SILENT_SHARE, SILENT_CHIP = LIMITS.faint, LIMITS.beside
"""Amplitude of a node below which no samples are a word, RMS; and of a chip that is a mean."""
TIED = 0.01
"""Share of the energy by which frames that explain it as well differ behind a low-pass."""
RAIL_MARGIN = 1e-3
"""Distance from a rail, relative to the range, within which a sample counts as clipped: one count
of a 10-bit converter."""
Rails = tuple[float, float] | None


class FrameReader:
    """Reads the frames of one digitizer; which timing the frames before had is carried over.

    expected_v: (n,) float32, V, the amplitude to expect of each node; may be changed. broken: (n,)
    uint8, nodes whose words are known to be uneven; may be changed.
    """

    def __init__(
        self,
        spec: FrameSpec,
        rate_hz: float,
        rails_v: Rails = None,
        active_share: float = 0.5,
        swing_v: float | None = None,
        side_chips: int = MOST_LATE,
    ) -> None:
        """Raise SpecError at a rate that frames cannot be read at.

        rails_v: lowest and highest level that is not cut off, V; None: unknown. active_share: of a
        node's amplitude, above which its word counts. swing_v: amplitude of a node's row, V; the
        specification's by default. side_chips: before and after a frame, that are looked at where
        they are seen.
        """
        self.spec, self.chip = spec, rate_hz * spec.chip_s
        self.swing_v = spec.node_swing_v if swing_v is None else swing_v
        self.integrated = abs(self.chip - 1) < 0.01
        if not (self.integrated or self.chip >= 1.9):
            raise SpecError(
                f"{self.chip:.2g} samples per chip: line timing takes one integrated value per "
                f"chip ({1 / spec.chip_s:.6g} Hz) or at least two samples"
            )
        self.expected_v = np.full(spec.nodes, self.swing_v or 0.0, np.float32)
        self.broken = np.zeros(spec.nodes, np.uint8)
        self._side_chips = side_chips
        chips = spec.chips if self.integrated else spec.span_chips
        self.size = math.ceil(chips * self.chip - 0.5)
        code = _code(spec, self.swing_v, active_share)
        rules = kernel.struct("frame_rules", **self._rules(rails_v))
        chosen = SPARSE_LIMITS if spec.sparse else LIMITS
        limits = kernel.struct("certificate_limits", **asdict(chosen))
        expected = kernel.pointer(self.expected_v, spec.nodes, written=True)
        broken = kernel.pointer(self.broken, spec.nodes)
        made = kernel.lib.frame_reader_new(code.at, rules.at, limits.at, expected, broken)
        self._held = kernel.Held(made, kernel.lib.frame_reader_free, code, rules)
        self._code, self.at = code, self._held.at
        self._found = kernel.ffi.new("struct frame_found *")
        self._rest = kernel.ffi.new("struct frame_rest *")
        self._memory = words_memory(spec.nodes)

    def _rules(self, rails_v: Rails) -> dict[str, Any]:
        """Return the members of the kernel's struct frame_rules."""
        spec, chip, swing_v = self.spec, self.chip, self.swing_v
        low, high = rails_v or (-math.inf, math.inf)
        margin = RAIL_MARGIN * (high - low) if rails_v else 0.0
        self._within_v = low + margin, high - margin
        return {
            "integrated": self.integrated,
            "mean_is_offset": (spec.first_row > 0 or spec.scramble) and spec.drive == BIPOLAR,
            "searches": not (self.integrated or spec.resync_chips),
            "size": self.size,
            "chip": chip,
            "least_chip": (1 - CHIP_ERROR) * chip,
            "most_chip": (1 + CHIP_ERROR) * (1 + MAX_STRETCH) * chip,
            "earliest": -1.0,
            "latest": 0.5,
            "tail": TAIL_CHIPS,
            "side": self._side_chips,
            "rail_low": low + margin,
            "rail_high": high - margin,
            "silent_power": (SILENT_SHARE * (swing_v or 0.0)) ** 2,
            "silent_chip": SILENT_CHIP * (swing_v or 0.0),
            "most_noise": blinding_noise_v(swing_v, spec.order),
            "deafened": DEAFENED,
            "clipped": CLIPPED,
            "kept": KEPT,
            "refined": REFINED,
            "searched": SEARCHED,
            "misfit": MISFIT,
            "tied": TIED,
            "blur": BLUR,
            "settled_chips": SETTLED_CHIPS,
            "turns": len(REACHES),
            "reaches": REACHES,
        }

    def count_above(self, active_share: float) -> None:
        """Let words count above this share of the amplitude to expect, from the next frame on."""
        self._code.at.active_share = active_share

    def learn_rest(self, level_v: float, chip_noise_v2: float) -> None:
        """Take this for the line at rest: its level, V, and the variance of a chip's level, V²."""
        rest = self._rest
        rest.level, rest.noise_v2, rest.known = level_v, chip_noise_v2, True

    def propose(self, start: float, chip: float) -> None:
        """Try this timing on the next frame, too: begin and duration of a chip, samples."""
        kernel.lib.frame_reader_propose(self.at, [{"start": start, "chip": chip}])

    def expect(self, start: float, chip: float, scatter: float, measures: bool = True) -> None:
        """Expect the next frame to begin within ±scatter of a start, with such chips; samples.

        measures: both are refined in any case.
        """
        fit = {"start": start, "chip": chip}
        kernel.lib.frame_reader_expect(self.at, [fit], scatter, measures)

    def _fitter(self, volts: Floats32, level_v: float) -> Any:
        """Return the kernel's fitter of these samples, (m,), for one call."""
        fitter, samples = kernel.lib.frame_reader_fitter(self.at), kernel.pointer(volts, volts.size)
        if not kernel.lib.fitter_line(fitter, samples, volts.size, level_v):
            raise MemoryError(f"no memory for sums of {volts.size} samples")
        return fitter

    def explained(self, volts: Floats32, start: float, chip: float, count: int) -> Floats:
        """Return the power that words explain, V², of frames that each begin a chip later.

        volts: (m,), of which start and chip, samples, are those of the first frame.
        """
        powers = np.empty(count)
        out = kernel.pointer(powers, count, written=True)
        fit = {"start": start, "chip": chip}
        kernel.lib.fitter_explained(self._fitter(volts, self._rest.level), fit, count, out)
        return powers

    def gains(self, volts: Floats32, chips: Floats, bits: int) -> Floats:
        """Return the energy that words explain of the first bits, by each duration of chips, (c,).

        volts: (m,) from a mark on, V, without the level of rest. chips: (c,), samples.
        """
        gains, durations = np.empty(chips.size), kernel.pointer(chips, chips.size)
        out = kernel.pointer(gains, chips.size, written=True)
        fitter = self._fitter(volts, 0.0)
        kernel.lib.fitter_gains(fitter, -0.5, bits, durations, chips.size, out)
        return gains

    def duration(self, volts: Floats32, start: float) -> float:
        """Return the duration of chips, samples, that suits a frame which begins there; or 0.

        volts: (m,). It ends where the line falls silent, about.
        """
        rest, noise_v2 = self._rest, self._rest.noise_v2
        loud_v = LIMITS.deviations * math.sqrt(noise_v2 * self.chip)
        loud_v = max(loud_v, LIMITS.faint_bit * (self.swing_v or 0.0))
        fitter = self._fitter(volts, rest.level)
        chip: float = kernel.lib.fitter_duration(fitter, noise_v2, start, loud_v)
        return chip

    def verdict(self, volts: Floats32, final: bool = True, searches: bool = False) -> int:
        """Read one frame, and return the kernel's verdict (enum frame_verdict); see `taken`.

        volts: (m,), NaN where absurd. final: no more will follow, else `more` tells how many are
        needed.
        """
        samples, words = kernel.pointer(volts, volts.size), self._new_words()
        verdict: int = kernel.lib.frame_reader_read(
            self.at, samples, volts.size, final, searches, self._rest, words, self._found
        )
        self._has_words = verdict == kernel.lib.FRAME_READ
        return verdict

    def _new_words(self) -> Any:
        """Return the kernel's words of the next frame, in memory of their own."""
        nodes = self.spec.nodes
        self._memory = words_memory(nodes)
        memory = kernel.pointer(self._memory, self._memory.size, written=True)
        return kernel.ffi.new("struct words *", kernel.lib.words_in(memory, nodes))

    def sum_up(self, mean_v: float, variance_v2: float) -> int:
        """Return the verdict on samples in which nobody spoke, of which this is known."""
        verdict: int = kernel.lib.frame_reader_sum_up(
            self.at, self._rest, mean_v, variance_v2, self._new_words(), self._found
        )
        self._has_words = verdict == kernel.lib.FRAME_READ
        return verdict

    def is_deaf(self, volts: Floats32) -> bool:
        """Whether so many samples are at a rail that a node may speak unheard."""
        low_v, high_v = self._within_v
        return float(np.mean((volts <= low_v) | (volts >= high_v))) > DEAFENED

    @property
    def due_chips(self) -> float:
        """Chips from a frame's begin until it can be read."""
        return float(self.spec.span_chips + TAIL_CHIPS)

    @property
    def silent_power(self) -> float:
        """Power of samples below which nobody speaks, V²."""
        return float((SILENT_SHARE * (self.swing_v or 0.0)) ** 2)

    @property
    def more(self) -> int:
        """Samples that the last frame needs beside those that were given."""
        return int(self._found.more)

    def taken(self, first_index: int) -> LineFrame:
        """Return the frame that was read last; first_index: of its samples in the stream."""
        return line_frame(self._found, self._has_words, self._memory, first_index, self.spec.nodes)


def mean_and_variance(volts: Floats32) -> tuple[float, float]:
    """Return the mean, V, and the variance, V², of samples, (m,)."""
    sums = kernel.lib.samples_add(kernel.pointer(volts, volts.size), volts.size)
    mean = sums.sum / volts.size
    return mean, max(sums.squares / volts.size - mean**2, 0.0)


def blinding_noise_v(swing_v: float | None, order: int) -> float:
    """Return the noise of a chip, V RMS, beyond which words are missed; infinite if unknown."""
    return math.inf if swing_v is None else swing_v * math.sqrt(order) / BLIND_RHO


def hides_silence(clipped: float, noise_rms_v: float, spec: FrameSpec) -> bool:
    """Whether a frame without words cannot be called silent, as a node that spoke might not show.

    clipped: share of its samples at a rail. noise_rms_v: of one chip's level, V; NaN if unknown.
    """
    return clipped > DEAFENED or noise_rms_v > blinding_noise_v(spec.node_swing_v, spec.order)


def _code(spec: FrameSpec, swing_v: float | None, active_share: float) -> kernel.Held:
    """Return the kernel's struct code, with all that it points to."""
    spare = spec.spare_rows
    correlates = Transform(spec.book.plan, spreading=False)
    spreads = Transform(spec.book.plan, spreading=True)
    pairs = np.zeros(0, TWIN)
    if not spec.scramble:
        pairs = twins(spec.order, spec.first_row, spec.nodes)
    null = kernel.ffi.NULL
    given = kernel.ffi.from_buffer("struct code_twin[]", pairs) if pairs.size else null
    sparse = sparse_code(spec, spreads) if spec.sparse else None
    held = kernel.struct(
        "code",
        bits=spec.line_bits,
        order=spec.order,
        nodes=spec.nodes,
        first=spec.first_row,
        span=spec.span_chips,
        spare=spare.start,
        spare_count=spare.stop - spare.start,
        unipolar=spec.drive == UNIPOLAR,
        scrambled=spec.scramble,
        parity=spec.parity,
        swing=math.nan if swing_v is None else swing_v,
        active_share=active_share,
        correlate=correlates.at,
        spread=spreads.at,
        flips=null if spec.flips is None else spec.flips,
        places=spec.places.astype(np.int32),
        sign_mask=spec.sign_mask,
        twins=given,
        twin_count=pairs.size,
        sparse=sparse.at if sparse else null,
    )
    return kernel.Held(held.at, None, held, correlates, spreads, given, sparse)
