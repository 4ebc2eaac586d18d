# SPDX-License-Identifier: Apache-2.0

"""When all nodes are to be asked to speak: at the start, and when a frame was not heard."""

import math

from ..words.groups import groups_of

LEAST_S = 0.1
"""s between two requests at least. Chosen: a tenth of a usual heartbeat."""
ANSWER_FRAMES = 3
"""Frames until the first one in which all were asked is decoded. Derived: the request reaches the
digitizer in the next frame, may be too late for the one after, and the third has to end."""
DOUBLED = 4
"""Times that this pause is doubled at most, while requests are needed again within twice the last
one. Chosen: a line that stays disturbed costs a round in sixteen."""


class Asking:
    """Decides when all nodes should be asked to speak (ASK in docs/protocol.md).

    wanted: values may be old, and not all nodes have spoken since. requests: made so far.
    log2_turns: all speak in 2^log2_turns frames, by turns.
    """

    def __init__(self, turns: int, period_s: float) -> None:
        """turns: in which no more nodes speak than are told apart. period_s: of frames."""
        self.wanted, self.requests, self.log2_turns = True, 0, turns.bit_length() - 1
        self._least_s = max(LEAST_S, (turns + ANSWER_FRAMES) * period_s)
        self._pause_s, self._asked_s = self._least_s, -math.inf
        self._groups = self._heard = 0  # of these groups, those that spoke since the last doubt

    def doubt(self) -> None:
        """Note that values are in doubt which were not before."""
        self.wanted, self._heard = True, 0

    def hear(self, turn: int) -> bool:
        """Note a certain frame in which all of this turn were asked; whether that ends a round."""
        groups = groups_of(turn)
        if groups != self._groups:
            self._groups, self._heard = groups, 0
        self._heard |= 1 << turn % groups
        return self._heard == (1 << groups) - 1

    def settle(self, are_left: bool) -> None:
        """Ask no more, unless nodes are left without a certain word and it may still help."""
        self.wanted = are_left and self._pause_s < self._least_s * 2**DOUBLED
        self._heard = 0

    def request(self, now_s: float) -> bool:
        """Tell whether to ask now, s, as is then noted."""
        since_s = now_s - self._asked_s
        if not self.wanted or since_s < self._pause_s:
            return False
        is_calm = since_s >= 2 * self._pause_s
        most_s = self._least_s * 2**DOUBLED
        self._pause_s = self._least_s if is_calm else min(2 * self._pause_s, most_s)
        self._asked_s, self.requests = now_s, self.requests + 1
        return True
