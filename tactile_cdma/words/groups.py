# SPDX-License-Identifier: Apache-2.0

"""In how many groups the nodes transmit by turns, where more want to speak than a frame holds."""

import math
from collections import deque

import numpy as np

from ..base.arrays import Bools
from ..wire._protocol import TURN_MOST_LOG2

OVERLOADS = 2
"""Frames of too many, without a round of others between, that divide the nodes. Chosen: one is a
disturbed frame."""
FULL = 0.8
CALM = FULL / 2
"""Share of the capacity that a group may fill; and that all nodes together have to stay below for
CALM_S until groups are joined, two and two and with a round in between: what nodes kept until their
turn, heartbeats too, they say at once. Chosen: how many spoke is an estimate, and no to and fro."""
CALM_S = 1.0
MOST_CALM_S = 64.0
"""To which CALM_S is doubled, time by time, where it was not the number that divided the nodes, but
that codes of those who spoke were not told apart: they will not be when groups are joined."""


def groups_of(turn: int) -> int:
    """Into how many groups nodes are divided in a frame of this turn; see docs/protocol.md."""
    return 1 << turn.bit_length() - 1 if turn else 1


def out_of_turn(turn: int, nodes: int) -> Bools:
    """The nodes that keep silent whatever they have to say, (n,)."""
    groups = groups_of(turn)
    waits: Bools = np.arange(1, nodes + 1) % groups != turn % groups
    return waits


class Groups:
    """Follows how many speak, and decides into how many groups they should be divided.

    Of those that speak in their turn, who did in the one before would speak in every frame; all
    others, as heartbeats do, in one of a round.

    now_log2: of the newest frame. wanted_log2: what the digitizer is to be asked for.
    spoke: (n,) bool, nodes that did in their last turn, in however many groups that was.
    """

    def __init__(self, nodes: int, capacity: int, period_s: float) -> None:
        """capacity: nodes that may speak in one frame. period_s: of frames."""
        self.now_log2 = self.wanted_log2 = 0
        self._capacity, self._calm_frames = capacity, math.ceil(CALM_S / period_s)
        self._most_calm_frames = math.ceil(MOST_CALM_S / period_s)
        self.spoke = np.zeros(nodes, np.bool_)
        # How many of each group would speak, if all did at once.
        self._round: deque[float] = deque(maxlen=1)
        self._over = self._since_over = self._calm = 0

    def hear(self, turn: int, active: Bools) -> None:
        """Take in who spoke in a frame of this turn, (n,), where all may in one frame."""
        waits = out_of_turn(turn, active.size) if turn else None
        self.spoke = active if waits is None else np.where(waits, self.spoke | active, active)

    def take(self, turn: int, speakers: int, active: Bools, crowded: bool = False) -> None:
        """Take in how many spoke in a frame of this turn, and as far as is known, who, (n,).

        crowded: their codes were not told apart.
        """
        log2 = groups_of(turn).bit_length() - 1
        if log2 != self.now_log2:
            self._calm = self._calm if log2 < self.now_log2 else 0
            self.now_log2, self._over = log2, 0
            self._round = deque(maxlen=1 << log2)
        if log2:
            again = int(np.count_nonzero(active & self.spoke))
            self._round.append(again + (speakers - again) / (1 << log2))
        else:
            self._round.append(speakers)
        self.hear(turn, active)
        is_over = crowded or speakers > self._capacity
        is_whole = len(self._round) == self._round.maxlen
        self._since_over = 0 if is_over else self._since_over + 1
        self._over = 0 if self._since_over >= 1 << log2 else self._over + is_over
        if is_whole:
            self._calm = self._calm + 1 if sum(self._round) <= CALM * self._capacity else 0
        if self._over >= OVERLOADS and log2 < TURN_MOST_LOG2:
            more = math.ceil(math.log2(speakers / (FULL * self._capacity)))
            wanted = min(max(log2 + max(more, 1), self.wanted_log2), TURN_MOST_LOG2)
            if crowded and wanted > self.wanted_log2:
                self._calm_frames = min(2 * self._calm_frames, self._most_calm_frames)
            self.wanted_log2 = wanted
        elif is_whole and self._calm >= self._calm_frames:
            self.wanted_log2 = max(log2 - 1, 0)
