# SPDX-License-Identifier: Apache-2.0

"""What is wrong, how bad it is, and for how long a finding stands so that levels do not flap."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

RAISE_REPORTS = 2
"""A state must be found in so many reports in a row: a single odd second is none."""
CLEAR_REPORTS = 5
"""A finding stands until it was absent from so many reports in a row."""


class Level(IntEnum):
    """How bad; the same values as the constants of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong.

    key: what, whatever its figures are just now. text: for people, with what to do about it.
    event: something that happened, which stands at once, and no state that may pass.
    """

    key: str
    level: Level
    text: str
    event: bool = False


class Settling:
    """Lets findings stand only after RAISE_REPORTS, and for CLEAR_REPORTS longer than they last."""

    def __init__(self) -> None:
        self._standing: dict[str, _Held] = {}

    def settle(self, found: Iterable[Finding]) -> list[Finding]:
        """The findings that stand after another report found these, worst first."""
        now = {finding.key: finding for finding in found}
        for key, finding in now.items():
            held = self._standing.setdefault(key, _Held(finding))
            held.finding, held.absent = finding, 0
            held.seen += 1
        for key in [key for key in self._standing if key not in now]:
            held = self._standing[key]
            held.absent += 1
            if not held.stands or held.absent >= CLEAR_REPORTS:
                del self._standing[key]
        standing = [held.finding for held in self._standing.values() if held.stands]
        return sorted(standing, key=lambda finding: -finding.level)


@dataclass(slots=True)
class _Held:
    finding: Finding
    seen: int = 0
    absent: int = 0

    @property
    def stands(self) -> bool:
        return self.finding.event or self.seen >= RAISE_REPORTS


def worst(findings: Iterable[Finding]) -> tuple[Level, str]:
    """The highest level, and what all findings of that level say; OK and nothing without any."""
    findings = list(findings)
    level = max((finding.level for finding in findings), default=Level.OK)
    return level, "; ".join(finding.text for finding in findings if finding.level == level)
