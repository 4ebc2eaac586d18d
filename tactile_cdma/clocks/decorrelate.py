# SPDX-License-Identifier: Apache-2.0

"""Separates nodes whose clocks differ, by least squares over all bits of all nodes of a frame.

With clocks of their own the rows lose their orthogonality, and bit m of one node overlaps bits
m ± 1 of others. But each node's waveform is known, so the samples y = A·x + noise determine all
amplitudes x (k bits of n nodes) by x = (AᵀA + λI)⁻¹Aᵀy. As a bit overlaps its neighbours only,
AᵀA is block-tridiagonal, and block elimination needs the samples of two bits at a time. With A[m]
the waveforms of bit m, D[0] = A[0]ᵀA[0] + λI and B[m] = D[m]⁻¹A[m]ᵀ:

    forward   v[m] = B[m]·(y − A[m−1]·v[m−1])      D[m] = A[m]ᵀ(I − A[m−1]·B[m−1])A[m] + λI
    backward  x[m] = v[m] − B[m]·(A[m+1]·x[m+1])

where products of neighbours run over the few samples only that their bits share. So a frame costs
little more than its correlation with dense waveforms.

λ bounds the noise for any clocks, and best is λ = N·S/ρ² (S samples per chip), which makes x the
linear estimate with the least mean error: the covariance of x is K·G·K for G = AᵀA and
K = (G + λI)⁻¹, whose eigenvalues g/(g + λ)² are at most 1/(4λ). The price is that K·G = I − λK
stands in for I: of its amplitude a node keeps the share 1 − λKᵢᵢ, the `resolution`. It is near 1
unless two nodes have nearly the same waveform.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arrays import Floats32, Indices
from ..base.errors import SpecError
from ..code.frame import UNIPOLAR, FrameSpec
from .node_clocks import NodeClocks
from .sampling import RAMP, row_samples

MAX_GAIN = 8.0
"""Largest noise of an estimate, over that of a correlation without crosstalk: sets λ. ρ/2 gives the
best λ, so 8 suits ρ = 16. Chosen; it costs little elsewhere."""
RESOLVED = 0.9
"""Resolution below which a node counts as not separated from some other. Chosen."""
MAX_BYTES = 1 << 29
"""Largest memory of one skin's matrices, bytes: 1024 nodes at 2 samples per chip fit. Chosen."""


class _Bit(NamedTuple):
    """One bit of all nodes, and of the pedestal.

    first, stop: its samples. rows: A[m]ᵀ, (u, stop − first). inverse: B[m], of the same shape.
    """

    first: int
    stop: int
    rows: Floats32
    inverse: Floats32


class Decorrelator:
    """Amplitudes of all bits of all nodes, from the samples of a frame, for given clocks.

    Immutable. Building it takes about 8·k·n²·(n + samples per bit) operations, some tenth of a
    second with 256 nodes: do that beside the stream when clocks have moved.

    samples: number needed from the sync edge on.
    noise_gain: (k, n) float32, noise of each estimate over the noise of one sample.
    resolution: (n,) float32, share of its amplitude that a node keeps in its worst bit.
    """

    def __init__(self, spec: FrameSpec, clocks: NodeClocks, per_chip: float) -> None:
        """Set up the equations and eliminate. per_chip: samples in a nominal chip.

        Raises SpecError where the clocks are too far apart or the skin is too large.
        """
        self.spec, self.clocks, self.per_chip = spec, clocks, per_chip
        most = spec.frame_period_s / spec.chip_s * per_chip
        if abs(most - round(most)) > 0.05:
            raise SpecError(
                f"a frame period of {most:.2f} samples lets the sampling slide against the sync "
                "edge: make it a whole number of samples"
            )
        if clocks.end_s(spec) > spec.frame_period_s:
            raise SpecError(
                f"the slowest node needs {clocks.end_s(spec) * 1e3:g} ms for its frame, longer "
                f"than the period of {spec.frame_period_s * 1e3:g} ms; lengthen frame_period_s"
            )
        self._bits = spec.line_bits
        windows = self._windows(round(most))
        self.samples = windows[-1][1]
        self.ridge = spec.order * per_chip / (4 * MAX_GAIN**2)
        size = sum(stop - first for first, stop in windows) * 8 * (spec.nodes + 1)
        if size > MAX_BYTES:
            raise SpecError(
                f"the decorrelator of {spec.nodes} nodes with {windows[0][1]} samples per bit "
                f"takes {size >> 20} MiB, more than {MAX_BYTES >> 20}: use fewer samples per chip, "
                "or frames with resync slots"
            )
        rows = spec.node_rows
        waveforms = [
            self._waveforms(rows, bit, first, stop) for bit, (first, stop) in enumerate(windows)
        ]
        self._blocks, inverses = self._eliminate(windows, waveforms)
        self.noise_gain, self.resolution = self._quality(inverses)

    @property
    def unresolved(self) -> Indices:
        """Nodes, counted from 0, whose waveforms at these clocks are those of some other."""
        return np.flatnonzero(self.resolution < RESOLVED)

    @property
    def gain(self) -> Floats32:
        """Noise of a node's worst bit over that of a correlation without crosstalk, (n,)."""
        clean = math.sqrt(self.spec.order * self.per_chip)
        worst: Floats32 = self.noise_gain.max(axis=0) * np.float32(clean)
        return worst

    def estimate(self, samples: Floats32) -> Floats32:
        """Amplitude of every bit of every node.

        samples: (≥ self.samples,) float32, V, from the sync edge on, gap level removed. Returns
        (k, n) float32, V, like correlations of the nodes' rows: row sign and polarity not applied.
        """
        line = np.array(samples[: self.samples], dtype=np.float32)
        values = np.empty((self._bits, self._blocks[0].rows.shape[0]), np.float32)
        for m, bit in enumerate(self._blocks):
            values[m] = bit.inverse @ line[bit.first : bit.stop]
            if m + 1 < self._bits:
                shared = slice(self._blocks[m + 1].first, bit.stop)
                line[shared] -= values[m] @ bit.rows[:, shared.start - bit.first :]
        for m in range(self._bits - 2, -1, -1):
            bit, later = self._blocks[m], self._blocks[m + 1]
            shared_size = bit.stop - later.first
            if shared_size > 0:
                left = values[m + 1] @ later.rows[:, :shared_size]
                values[m] -= bit.inverse[:, later.first - bit.first :] @ left
        return values[:, : self.spec.nodes]

    def line(self, amplitudes: Floats32, nodes: ArrayLike | None = None) -> Floats32:
        """The samples that these amplitudes would give: (self.samples,) float32, V.

        amplitudes: (k, n) float32, V; or (k, c) of only these c nodes, counted from 0.
        """
        total = np.zeros(self.samples, np.float32)
        pedestal = self.spec.nodes
        chosen = slice(pedestal) if nodes is None else np.asarray(nodes)
        for bit, values in zip(self._blocks, amplitudes, strict=True):
            window = total[bit.first : bit.stop]
            window += values @ bit.rows[chosen]
            if self.spec.drive == UNIPOLAR:
                window += np.abs(values).sum() * bit.rows[pedestal]
        return total

    def _windows(self, available: int) -> list[tuple[int, int]]:
        """First and last + 1 sample of each bit, of the earliest and the latest node."""
        spec = self.spec
        edges = np.arange(self._bits + 1) * spec.order
        instants = (edges + self.clocks.displacement(edges)) * self.per_chip - 0.5
        early = np.ceil(instants.min(axis=0) - RAMP / 2)
        late = np.floor(instants.max(axis=0) + RAMP / 2) + 1
        first, stop = np.clip([early[:-1], late[1:]], 0, available).astype(int).tolist()
        if any(a > b for a, b in zip(stop, first[2:], strict=False)):
            raise SpecError(
                f"the nodes' clocks are {self.clocks.spread_chips(spec):.3g} chips apart by the "
                f"end of a frame, but a bit has only {spec.order}: discipline the clocks, or use "
                "frames with resync slots"
            )
        return list(zip(first, stop, strict=True))

    def _waveforms(self, rows: NDArray[np.int8], bit: int, first: int, stop: int) -> Floats32:
        """Waveforms of one bit, (u, stop − first): the nodes', then the pedestal's.

        The pedestal takes up a residual offset, and the mean level of unipolar nodes: what an
        all-ones row gives, averaged over the nodes' clocks. Where row 0 is a node's there is none.
        """
        edge = np.array(float(bit * self.spec.order))
        begin = edge + self.clocks.displacement(edge)
        chip = 1.0 + self.clocks.rate_error
        flips = 1 if self.spec.flips is None else self.spec.flips[bit].astype(np.int8)
        nodes = row_samples(rows * flips, begin, chip, first, stop, self.per_chip)
        if self.spec.first_row == 0 and not self.spec.scramble:
            return nodes
        ones = np.ones_like(rows)
        pedestal = row_samples(ones, begin, chip, first, stop, self.per_chip).mean(axis=0)
        return np.concatenate((nodes, pedestal[None]))

    def _eliminate(
        self, windows: list[tuple[int, int]], waveforms: list[Floats32]
    ) -> tuple[list[_Bit], list[NDArray[Any]]]:
        """The forward elimination: bits, and D[m]⁻¹ of each."""
        bits: list[_Bit] = []
        inverses = []
        for (first, stop), rows in zip(windows, waveforms, strict=True):
            # Sums of up to 2¹⁶ products of ±1 are exact in float32.
            normal = (rows @ rows.T).astype(np.float64)
            normal[np.diag_indices_from(normal)] += self.ridge
            shared = bits[-1].stop - first if bits else 0
            if shared > 0:
                mine, theirs = rows[:, :shared], bits[-1].rows[:, -shared:]
                inner = theirs.T @ bits[-1].inverse[:, -shared:]
                normal -= mine @ ((inner + inner.T) / 2) @ mine.T
            inverses.append(np.linalg.inv(normal))
            bits.append(_Bit(first, stop, rows, inverses[-1].astype(np.float32) @ rows))
        return bits, inverses

    def _quality(self, inverses: list[NDArray[Any]]) -> tuple[Floats32, Floats32]:
        """noise_gain and resolution, from the diagonal blocks of K.

        They follow backwards, K[m] = D[m]⁻¹ + B[m]A[m+1]·K[m+1]·(B[m]A[m+1])ᵀ. Of λK² only the
        part within a bit is subtracted, which errs to the side of more noise.
        """
        nodes = self.spec.nodes
        block = inverses[-1]
        gain = np.empty((self._bits, nodes), np.float32)
        kept = np.empty((self._bits, nodes), np.float32)
        for m in range(self._bits - 1, -1, -1):
            bit = self._blocks[m]
            shared = bit.stop - self._blocks[m + 1].first if m + 1 < self._bits else 0
            later, block = block, inverses[m]
            if shared > 0:
                theirs, mine = self._blocks[m + 1].rows[:, :shared], bit.inverse[:, -shared:]
                block = block + mine @ (theirs.T @ later @ theirs) @ mine.T
            own = np.diag(block)[:nodes]
            gain[m] = np.sqrt(own - self.ridge * np.square(block).sum(axis=1)[:nodes])
            kept[m] = 1 - self.ridge * own
        return gain, kept.min(axis=0)
