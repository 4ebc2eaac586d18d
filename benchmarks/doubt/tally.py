# SPDX-License-Identifier: Apache-2.0

"""What `make bench-doubt` counts: each field of a tally is a column of its table."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol


class Tally(NamedTuple):
    """Counts of words, of nodes that sent or should have.

    words: those sent. right: the word that was sent, without a flag; flagged: with one. tied: the
        same with a flag, in a frame that is given by nothing but the waveform, where another start
        with other words gives exactly the same waveform: there a flag is due.
    missed: a node transmitted, and its frame is published with the node silent, without a flag.
    wrong_flagged: another word, or one where none was, with a flag. wrong, invented: the same
        without one; of a node that transmitted, and of one that did not.
    lost: the frame was rejected or not found, which claims nothing.
    rail_silent: published as silent, without a flag, although more than half of the frame's samples
        were at a rail. phantom: words, without a flag, of nodes that never transmitted.
    silences, silent_flagged: of nodes that did not transmit and are published as silent, all and
        those with a flag that is not due to such a tie.

    Claims of what is touched and held, see `touches`:
    claims: `touched`, `untouched`, and held values of taxels, that were made. stale_claims: those
        of them that were false. unclaimed: frames of which neither was claimed.

    False claims of others, see `zeros`, `stamps` and `printed`: false_zeros, stamps_off, tares,
    fast_frames, decode_silent.

    A flag is what the driver publishes: a doubtful word, or a node that counts as doubled or
    faulty.
    """

    words: int = 0
    right: int = 0
    flagged: int = 0
    missed: int = 0
    wrong_flagged: int = 0
    wrong: int = 0
    invented: int = 0
    lost: int = 0
    rail_silent: int = 0
    phantom: int = 0
    tied: int = 0
    silences: int = 0
    silent_flagged: int = 0
    claims: int = 0
    stale_claims: int = 0
    unclaimed: int = 0
    false_zeros: int = 0
    stamps_off: int = 0
    tares: int = 0
    fast_frames: int = 0
    decode_silent: int = 0

    @property
    def unflagged(self) -> int:
        """Return words that are false without a flag."""
        return self.missed + self.wrong + self.invented

    @property
    def flagged_share(self) -> float:
        """Return the share of right words that are flagged."""
        return self.flagged / max(self.right + self.flagged, 1)

    @property
    def silent_flagged_share(self) -> float:
        """Return the share of silences that are flagged."""
        return self.silent_flagged / max(self.silences, 1)

    @property
    def doubted_share(self) -> float:
        """Return the share of right words and silences, together, that are flagged."""
        flagged = self.flagged + self.silent_flagged
        return flagged / max(self.right + self.flagged + self.silences, 1)

    @property
    def false(self) -> int:
        """Return all that was claimed, without a flag, and is not so."""
        held = self.stale_claims + self.false_zeros + self.tares + self.fast_frames
        told = self.stamps_off + self.decode_silent
        return self.unflagged + self.rail_silent + self.phantom + held + told


def total(tallies: Iterable[Tally]) -> Tally:
    """Return the sums of all columns."""
    return Tally(*map(sum, zip(*tallies, strict=True)))


class Condition(Protocol):
    """Says what the driver is put through, and what is true there.

    rough: so disturbed that right words may be flagged, and lost.
    """

    @property
    def name(self) -> str: ...

    @property
    def rough(self) -> bool: ...

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """Count what is claimed in so many frames; also the first false claims, in words."""
