# SPDX-License-Identifier: Apache-2.0

"""A frame as the line shows it: when it was, its words, and the certificate of these."""

from __future__ import annotations

import operator
from dataclasses import astuple, dataclass, fields
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import kernel
from ..base.arrays import Bools, Floats32
from ..base.stage import stage
from ..words.words import Words


class Clause(IntEnum):
    """What a certificate looks at: enum certificate_clause in kernel/certificate.h."""

    ENERGY, ATOMS, RIVALS, REST, WORDS = range(5)

    @property
    def doubt(self) -> str:
        """Why a frame is in doubt where this clause fails, in words for a person."""
        return _DOUBTS[self]


_DOUBTS = {
    Clause.ENERGY: "more is left than noise and edges explain",
    Clause.ATOMS: "something is left that looks like a node",
    Clause.RIVALS: "other words would explain it as well",
    Clause.REST: "the line is not at rest beside the frame, or moves within it",
    Clause.WORDS: "parts of words lie about, or too many speak",
}


class Certificate(NamedTuple):
    """How near a frame is to each limit; see kernel/certificate.h.

    left_v2: mean square that its words leave of a chip, V². row_noise_v: of a level of a row, RMS.
    swing_v: a node's amplitude that it was judged by, V. energy … words: value of each clause, of
    which 1 is the limit.
    """

    left_v2: float
    row_noise_v: float
    swing_v: float
    energy: float
    atoms: float
    rivals: float
    rest: float
    words: float

    @property
    def values(self) -> tuple[float, ...]:
        """The values of all clauses, in the order of Clause."""
        return self[3:]

    @property
    def weakest(self) -> Clause:
        """The clause that is nearest to its limit, or farthest beyond."""
        values = self.values
        return Clause(values.index(max(values)))

    @property
    def holds(self) -> bool:
        """Whether no clause is beyond its limit."""
        # As all() does, in a third of the time: every frame is asked.
        _, _, _, energy, atoms, rivals, rest, words = self
        return energy < 1 and atoms < 1 and rivals < 1 and rest < 1 and words < 1


@stage
class LineFrame:
    """One frame, or one in which nobody spoke.

    start: stream index, fractional, at which the first chip begins; sample i is instant i.
    chip_samples: duration of a chip, samples.
    words: of the nodes; None where the line held too little power for any.
    certificate: of these words; None without. speakers: how many nodes spoke.
    understood: the line is at rest beside it, and without words of few nodes that are uneven, no
        more than noise is left: they say something of their nodes. Or nobody spoke, but words that
        are all too weak explain it.
    noise_rms_v: noise of one chip's level, V. level_v: of the line in silence, V.
    clipped: share of the frame's samples at a rail, 0…1.
    memory: the words as the kernel lays them, which `words` are views of.
    turn: whose it is, where groups of nodes transmit by turns; 0: everybody's. asked: all of these
        were asked to speak.
    crowded: the sparse codes of those who spoke are not told apart.
    """

    start: float
    chip_samples: float
    words: Words | None
    certificate: Certificate | None
    speakers: int
    understood: bool
    noise_rms_v: float
    level_v: float
    clipped: float
    memory: NDArray[np.uint8]
    turn: int = 0
    asked: bool = False
    crowded: bool = False


@dataclass(frozen=True, slots=True)
class Rejections:
    """Stretches of the line of which nothing is claimed, neither words nor silence, by reason.

    incomplete: cut off by a hole in the stream, a mark or its end. absurd: NaN, or volts that no
    digitizer reports. at_rail: so many samples that whoever spoke may not show. noisy: noise would
    hide words. misfit: something was sent that no words explain.
    """

    incomplete: int = 0
    absurd: int = 0
    at_rail: int = 0
    noisy: int = 0
    misfit: int = 0

    @property
    def total(self) -> int:
        """All of them."""
        return self.incomplete + self.absurd + self.at_rail + self.noisy + self.misfit

    @property
    def leading(self) -> str:
        """The most frequent reason."""
        return max((item.name for item in fields(self)), key=lambda name: getattr(self, name))

    def since(self, before: Rejections) -> Rejections:
        """Return those since a moment, of which `before` is the count."""
        return Rejections(*map(operator.sub, astuple(self), astuple(before)))


def words_memory(nodes: int) -> NDArray[np.uint8]:
    """Return memory for the words of a frame: see words_in in kernel/words.h."""
    return np.empty(kernel.lib.WORDS_BYTES * nodes, np.uint8)


def words_of(memory: NDArray[np.uint8], nodes: int, noise_rms_v: float) -> Words:
    """Return the words that the kernel has written there."""
    # By slices: rows that a matrix is unpacked to end by an exception, which takes a microsecond.
    floats: Floats32 = memory[: 12 * nodes].view(np.float32)
    flags: Bools = memory[16 * nodes :].view(np.bool_)
    return Words(
        active=flags[:nodes],
        codes=memory[12 * nodes : 16 * nodes].view(np.int32),
        amplitude_v=floats[:nodes],
        rho=floats[nodes : 2 * nodes],
        margin=floats[2 * nodes :],
        doubtful=flags[nodes : 2 * nodes],
        doubled=flags[2 * nodes : 3 * nodes],
        odd=flags[3 * nodes : 4 * nodes],
        faint=flags[4 * nodes :],
        noise_rms_v=noise_rms_v,
    )


def line_frame(
    found: Any,
    has_words: bool,
    memory: NDArray[np.uint8],
    first_index: int,
    nodes: int,
    turn: int = 0,
    asked: bool = False,
) -> LineFrame:
    """Return what the kernel found (struct frame_found); memory: of the words, which it keeps.

    The members of the kernel's struct certificate begin with those of Certificate. first_index: of
    its samples in the stream.
    """
    words = certificate = None
    told = found.certificate
    if has_words:
        words = words_of(memory, nodes, found.chip_noise_v)
        numbers = kernel.ffi.cast("double *", kernel.ffi.addressof(found, "certificate"))
        certificate = Certificate._make(kernel.ffi.unpack(numbers, len(Certificate._fields)))
    return LineFrame(
        first_index + found.start, found.chip, words, certificate, told.speakers, told.understood,
        found.chip_noise_v, found.level, found.clipped, memory, turn, asked, told.crowded,
    )  # fmt: skip


def rejections_of(counts: Any) -> Rejections:
    """Return the kernel's counts of rejected frames, by enum frame_verdict."""
    verdicts = {
        one.name: getattr(kernel.lib, f"FRAME_{one.name.upper()}") for one in fields(Rejections)
    }
    return Rejections(**{name: counts[verdict] for name, verdict in verdicts.items()})
