# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel, built from kernel/, whose module.c lists the arguments of every function.

Arrays are contiguous; of another type or size they raise TypeError or ValueError that names the
function and the argument. Settings are C structs that base/kernel.py makes; it also chooses whether
the kernel is used.
"""

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from .base.arrays import Bools, Floats, Floats32, Int32s
from .driver.clock import PassedPacket
from .wire.packets import Found

Settings = NDArray[np.void]

VERSION: int
"""Of these functions."""
STRUCTS: dict[str, tuple[int, tuple[tuple[str, int, str], ...]]]
"""Bytes of each struct of settings, and its members: name, offset, type as in Python's struct."""
LANES: int
"""float32 values that are computed at once on this processor."""

@final
class Transform:
    """Product with a Kronecker product of Hadamard matrices, the first varying slowest."""

    def __new__(
        cls, twos: int, orders: NDArray[np.uintc], signs: NDArray[np.int8], scale: float, lanes: int
    ) -> Transform:
        """twos: factors of order 2, which come first. orders: of the others, P ≤ 512.

        signs: their matrices (P, P) of ±1, one after the other. scale: of the product. lanes: 1, 4
        or 8; 0 for what the processor has. The result is the same bits for any number of lanes.
        """

    def multiply(self, source: Floats32, out: Floats32, /) -> None:
        """Vectors (…, N) times the transposed matrix, into out of the same size, or in place."""

def fit_words(
    frame: Settings, rows: Floats32, amplitude: Floats32, uneven: Floats32, *more: Floats32
) -> None:
    """As numpy_fit_words in framing/fit.py, into those after rows."""

def word_noise(frame: Settings, spare: int, spare_count: int, rows: Floats32, /) -> float:
    """As numpy_noise_of in code/separate.py."""

@final
class Readout:
    """Words and readings of plain frames at once; see kernel/readout.h and readings/readout.py."""

    def __new__(cls, settings: Settings, /, *arrays: NDArray[np.generic]) -> Readout:
        """arrays: as struct readout_skin; source: int32 (t,), or empty where taxels are nodes.

        It keeps them, and writes to those that are kept.
        """

    def read(self, rows: Floats32, *given: Any) -> int:
        """Enum readout_look.

        given: per_noise, least_usual, in_place, now_s, stale_after_s; drift V, tare Pa; out.
        Out: active, codes (n,); amplitude, rho, margin (3, n); doubtful, doubled, odd (3, n);
        pressure, voltage (2, t); status (t,); of nodes: V, Pa before the tare (2, n); valid (n,).
        """

# add_samples and read_packets are taken by kernel.either.

@final
class Scanner:
    """Finds the intact packets in a stream of bytes; as Scanner in wire/packets.py."""

    def __new__(cls, most_repeated: int) -> Scanner: ...
    def feed(self, data: bytes, /) -> list[Found]:
        """Type, sequence and payload of the packets that these bytes complete."""

    def skip(self) -> None:
        """Bytes were left out here."""

    def held(self) -> int:
        """Bytes of an incomplete packet."""

    def counts(self) -> dict[str, int]:
        """Fields of Counters."""

@final
class Stream:
    """Goes from event to event; see kernel/frame_stream.h.

    Methods raise RuntimeError while another thread is in `next`.
    """

    def __new__(cls, scanner: object, /) -> Stream:
        """scanner: shared with the parser."""

    def describe(
        self, stream_rules: Settings, transform: object, flips: Floats32, rows: Floats32
    ) -> None:
        """flips: (k, N), or empty. rows: (k, N), written to with every frame."""

    def forget(self) -> None: ...
    def carry(
        self, stream_timing: Settings, whole: Int32s, share: Floats, number: Floats, places: Int32s
    ) -> None:
        """Arrays: of ChipEdges.within; empty where there is no frame."""

    def give(self, data: bytes, t_host: float, backlog: bool, /) -> None:
        """Bytes to go on with. Raises RuntimeError while others are not used up."""

    def end(self) -> None: ...
    def next(
        self, file: int, timeout_ms: int, /
    ) -> tuple[int, Any, list[PassedPacket], float, bool]:
        """Event; what it is about; packets that passed; when the last bytes were read, s; backlog.

        Without the GIL; file −1: no more than the given bytes. Raises OSError where nothing can be
        read.
        """

    def place(self, answer: int, origin: int, anew: bool, mean: float, variance: float, /) -> bool:
        """Whether a frame was cut short."""

    def open(self, due: int, /) -> None: ...
    def decide(self, due: int, over: int, level_v: float, /) -> None: ...
    def look(self, due: int, /) -> None: ...

@final
class Sparse:
    """Multiuser detection with one book; see kernel/sparse.h. For one thread at a time."""

    def __new__(
        cls,
        rules: Settings,
        walsh: Transform,
        flips: Floats32,
        places: Int32s,
        codes: Int32s,
        nodes: int,
        /,
    ) -> Sparse:
        """places: (k, N) of chips in 2^m. codes: (2^m) of rows; those of nodes are 1 … nodes.

        flips: (k, N). walsh: of order 2^m, unscaled.
        """

    def detect(
        self,
        chips: Floats32,
        damping: float,
        rows: Floats32,
        heard: Bools,
        left: Floats32,
        power: Floats,
        /,
    ) -> tuple[float, bool]:
        """As numpy_detect in code/detect.py, into those after damping; level, V, and settled."""

    def loudness(self, chips: Floats32, lateness: int, late: bool, loudness: Floats32, /) -> None:
        """As numpy_loudness there, of chips that are read so many earlier, or later."""

@final
class Code:
    """How frames of one specification are spread and correlated; see kernel/fit.h, judge.h."""

    def __new__(
        cls,
        frame: Settings,
        correlate: Transform,
        spread: Transform,
        flips: Floats32,
        places: Int32s,
        span: int,
        /,
    ) -> Code:
        """flips: (k·N) of the scrambler, or none. places: (k·N) of coded chips among `span`."""

    def refine(
        self, volts: Floats, sums: Floats, blur: float, settled_chips: float, *more: Any
    ) -> tuple[float, float]:
        """Start and chip duration as numpy_refine in framing/fit.py finds them.

        sums: (m + 1,) of the first 0 to m volts. more: reaches (chips), start, chip, earliest and
        latest (samples), and float32 scratch, of any size, if that is enough.
        """

    def weigh(self, *given: Any) -> tuple[float, float, int]:
        """As weigh in framing/judge.py, into the arrays from rows on; see kernel/module_frames.c.

        Returns distortion and variance by which chips voted, and the chips of the longest view.
        """

    def look(self, *given: Any) -> tuple[Any, ...] | None:
        """What GapSearch.look in framing/gap.py makes a Look of; see kernel/module_frames.c.

        Returns what there is, gap, burst, proven, fit, unaided and beside, and the words in the
        arrays. None where there are too few samples for a gap.
        """
