# SPDX-License-Identifier: Apache-2.0

"""Counts the words of published frames that differ from what the nodes really sent."""

from __future__ import annotations

from tactile_cdma.driver.pipeline import TactileFrame
from test.support.oracle import Oracle, Verdict

from .outcome import Tally


class Judge:
    """Compares the frames that one driver publishes with what the nodes really sent.

    Campaigns extend it by what else they can tell: times, pressures, counts.
    tally: the result so far.
    """

    def __init__(self) -> None:
        self.tally = Tally()
        self.oracle = Oracle()

    def check(self, frame: TactileFrame) -> Verdict:
        """Compare the next published frame, and count its wrong words."""
        verdict = self.oracle.check(frame)
        self.tally.frames += 1
        self.tally.wrong_values += int(verdict.wrong.sum() + verdict.missed.sum())
        return verdict
