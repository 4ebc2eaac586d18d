# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel, built from kernel/, whose module.c lists the arguments of every function.

Arrays are contiguous; of another type or size they raise TypeError or ValueError that names the
function and the argument. Settings are C structs that base/kernel.py makes; it also chooses whether
the kernel is used.
"""

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from .driver.clock import PassedPacket
from .wire.packets import Found

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
        cls,
        twos: int,
        orders: NDArray[np.uintc],
        signs: NDArray[np.int8],
        scale: float,
        lanes: int,
        /,
    ) -> Transform:
        """twos: factors of order 2, which come first. orders: of the others, P ≤ 512.

        signs: their matrices (P, P) of ±1, one after the other. scale: of the product. lanes: 1, 4
        or 8; 0 for what the processor has. The result is the same bits for any number of lanes.
        """

    def multiply(self, source: NDArray[np.float32], out: NDArray[np.float32], /) -> None:
        """Vectors (…, N) times the transposed matrix, into out of the same size, or in place."""

def fit_words(
    frame: NDArray[np.void],
    rows: NDArray[np.float32],
    amplitude: NDArray[np.float32],
    uneven: NDArray[np.float32],
    pedestal: NDArray[np.float32],
    power: NDArray[np.float32],
    spread: NDArray[np.float32],
    misfit: NDArray[np.float32],
    /,
) -> None:
    """As numpy_fit_words in framing/fit.py, into those after rows."""

def word_noise(
    frame: NDArray[np.void], spare: int, spare_count: int, rows: NDArray[np.float32], /
) -> float:
    """As numpy_noise_of in code/separate.py."""

@final
class Readout:
    """Words and readings of plain frames at once; see kernel/readout.h and readings/readout.py."""

    def __new__(cls, settings: NDArray[np.void], /, *arrays: NDArray[np.generic]) -> Readout:
        """arrays: as struct readout_skin; source: int32 (t,), or empty where taxels are nodes.

        It keeps them, and writes to those that are kept.
        """

    def read(
        self,
        rows: NDArray[np.float32],
        per_noise: float,
        least_usual: float,
        in_place: bool,
        now_s: float,
        stale_after_s: float,
        drift_v: NDArray[np.float32],
        tare_pa: NDArray[np.float32],
        /,
        *out: NDArray[np.generic],
    ) -> int:
        """Enum readout_look.

        out: active, codes (n,); amplitude, rho, margin (3, n); doubtful, doubled, odd (3, n);
        pressure, voltage (2, t); status (t,); of nodes: V, Pa before the tare (2, n); valid (n,).
        """

def gather_contacts(
    contact_pa: float,
    release_pa: float,
    rim_pa: float,
    saturated: int,
    neighbours: NDArray[np.int32],
    moments: NDArray[np.float64],
    pressure_pa: NDArray[np.float32],
    status: NDArray[np.uint8],
    place: NDArray[np.int32],
    unread: NDArray[np.uint8],
    /,
    *out: NDArray[np.generic],
) -> int:
    """As NumpyGatherer in readings/gather.py; returns the number of contacts.

    place, unread: (t,), kept from frame to frame. out: int32 (3, t) and float64 (2, t) scratch;
    taxels, places (t,), starts (t + 1,) int32; sums (t, 11) float64; peak_pa (t,) float32; bool
    (3, t): saturated, lower_bound, torn. Raises ValueError for a neighbour that is no taxel.
    """

def to_volts(
    zero: float, per_count: float, counts: NDArray[np.int16], volts: NDArray[np.float32], /
) -> None:
    """As numpy_volts in base/sums.py."""

def copy_samples(most_v: float, volts: NDArray[np.float32], copy: NDArray[np.float64], /) -> None:
    """As numpy_copy there."""

def add_samples(volts: NDArray[np.float64], /) -> tuple[float, float]:
    """As numpy_sums there."""

def count_outside(low_v: float, high_v: float, volts: NDArray[np.float64], /) -> int:
    """As numpy_outside there."""

def mean_chips(
    level_v: float,
    received: NDArray[np.float64],
    whole: NDArray[np.int32],
    share: NDArray[np.float64],
    number: NDArray[np.float64],
    places: NDArray[np.int32],
    chips: NDArray[np.float32],
    /,
) -> None:
    """As numpy_mean_chips in framing/fit.py, into chips; whole must rise within the samples."""

def read_packets(file: int, timeout_ms: int, /) -> tuple[bytes, bool]:
    """Bytes up to a delimiter or later, fewer after the time; whether the last ones had waited.

    Raises OSError where nothing can be read.
    """

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
        self,
        stream_rules: NDArray[np.void],
        transform: object,
        flips: NDArray[np.float32],
        rows: NDArray[np.float32],
        /,
    ) -> None:
        """flips: (k, N), or empty. rows: (k, N), written to with every frame."""

    def forget(self) -> None: ...
    def carry(
        self,
        stream_timing: NDArray[np.void],
        whole: NDArray[np.int32],
        share: NDArray[np.float64],
        number: NDArray[np.float64],
        places: NDArray[np.int32],
        /,
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
class Code:
    """How frames of one specification are spread and correlated; see kernel/fit.h, judge.h."""

    def __new__(
        cls,
        frame: NDArray[np.void],
        correlate: Transform,
        spread: Transform,
        flips: NDArray[np.float32],
        places: NDArray[np.int32],
        span: int,
        /,
    ) -> Code:
        """flips: (k·N) of the scrambler, or none. places: (k·N) of coded chips among `span`."""

    def refine(
        self,
        volts: NDArray[np.float64],
        sums: NDArray[np.float64],
        blur: float,
        settled_chips: float,
        reaches: NDArray[np.float64],
        start: float,
        chip: float,
        earliest: float,
        latest: float,
        scratch: NDArray[np.float32],
        /,
    ) -> tuple[float, float]:
        """Start and chip duration as numpy_refine in framing/fit.py finds them.

        sums: (m + 1,) of the first 0 to m volts. scratch: of any size, if that is enough.
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
