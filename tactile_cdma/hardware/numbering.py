# SPDX-License-Identifier: Apache-2.0

"""Gives nodes their numbers: asks for one taxel after the other to be pressed. No I/O.

All nodes have one image (programmer.py). The digitizer announces a number (docs/protocol.md,
numbers); the node that is pressed keeps it, and from then on speaks whenever it is announced.
Nobody else speaks: so what is heard tells whether it was taken, and by how many.
"""

from ..wire.messages import Number
from ..words.words import Words

TAKEN_FRAMES = 5
"""Frames in a row with a clear word of the number's node. Chosen."""
UNCLEAR_FRAMES = 25
"""Unclear frames in a row, as of two nodes at once. Chosen: 0.3 s, more than a disturbance."""
TALKING_FRAMES = 400
"""Frames after which nodes that do not fall silent are told of. Chosen: 5 s at 78 frames/s."""
EARLY_FRAMES = 50
"""Frames that a pressed node takes to get a number, at least: 8 alike, then one per octet of its
memory (54 or more). One that is clear before had it already, and nobody has pressed anything."""
FORGET_FRAMES = 40
"""Frames that tell nodes to forget; they want 9 alike, and a node that talks may miss some."""


class Numbering:
    """Chooses the number that is announced, and keeps what is known of those before.

    asked: the number that a pressed node takes next; None: all have theirs. skipped: nobody's.
    """

    def __init__(self, nodes: int) -> None:
        self.asked: int | None = 1
        self.skipped: list[int] = []
        self._nodes = nodes
        self._forgets, self._left = 0, FORGET_FRAMES  # all of them, first
        self._clear = self._unclear = self._talking = 0
        self._frames = 0  # of this request
        self._early: int | None = None  # the number that somebody had before it was asked for

    @property
    def request(self) -> Number:
        """Tell what the digitizer has to announce now."""
        if self._left:
            return Number(self._forgets, forget=True)
        return Number(self.asked or 0)

    @property
    def waits(self) -> bool:
        """Tell whether somebody has to press a taxel, once the digitizer announces that."""
        return not self._left and self.asked is not None

    def take(self, words: Words) -> str | None:
        """Take in a frame of the present request. Returns what to tell about it, if anything."""
        if self._left:
            self._left = FORGET_FRAMES if words.active.any() else self._left - 1
            self._talking += bool(words.active.any())
            if not words.active.any() or self._talking % TALKING_FRAMES:
                return None
            talk = ", ".join(str(node + 1) for node in words.active.nonzero()[0][:8])
            return f"waiting: node {talk} keeps speaking: is it flashed with a number of its own?"
        if self.asked is None:
            return None
        node = self.asked - 1
        self._frames += 1
        heard = bool(words.active[node] or words.doubtful[node])
        clear = bool(words.active[node] and not words.doubtful[node] and not words.doubled[node])
        self._clear = self._clear + 1 if clear else 0
        self._unclear = self._unclear + 1 if heard and not clear else 0
        if self._unclear >= UNCLEAR_FRAMES:
            return self.unclear()
        if self._clear < TAKEN_FRAMES:
            return None
        if self._frames < EARLY_FRAMES + TAKEN_FRAMES:
            return self._had_before(self.asked)
        self._begin(self.asked + 1)
        return f"node {node + 1} has its number"

    def unclear(self) -> str:
        """Take the number from the nodes of which more than one took it. Returns what to tell."""
        self._begin(self.asked, forgets=self.asked or 0)
        return f"node {self.asked} is not clear: several taxels at once? Let go, press only one"

    def back(self) -> str:
        """Take the number from the last node, a wrong taxel's. Returns what to tell."""
        last = self._nodes if self.asked is None else self.asked - 1
        if not last:
            return "there is no number before 1"
        self._begin(last, forgets=last)
        if last in self.skipped:
            self.skipped.remove(last)
        return f"node {last} has lost its number"

    def skip(self) -> str:
        """Leave out the number that is asked for: nobody has it. Returns what to tell."""
        if self.asked is None:
            return "there is no number left"
        skipped = self.asked
        self.skipped.append(skipped)
        self._begin(skipped + 1, forgets=skipped)  # whoever took it meanwhile
        return f"node {skipped} is left out"

    def _had_before(self, number: int) -> str | None:
        """Have a node forget the number that it had before, unless it got it here."""
        if self._early == number:
            self._clear = self._frames = 0
            return None
        self._early = number
        self._begin(number, forgets=number)
        return (
            f"node {number} speaks before it is pressed: does it have a number? All nodes "
            "take one image (node --any)"
        )

    def _begin(self, asked: int | None, forgets: int | None = None) -> None:
        """Go on with another request, before which nodes may be told to forget a number."""
        self.asked = asked if asked is not None and asked <= self._nodes else None
        if forgets is not None:
            self._forgets, self._left = forgets, FORGET_FRAMES
        self._clear = self._unclear = self._frames = 0
