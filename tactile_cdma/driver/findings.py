# SPDX-License-Identifier: Apache-2.0

"""Tells what is wrong, how bad it is, and for how long that is reported, lest levels flap."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

RAISE_REPORTS = 2
"""Reports in a row that must find a state before it stands. Chosen: one odd second does not."""
CLEAR_REPORTS = 5
"""Reports in a row without a finding that end it. Chosen: long enough to be read."""


class Level(IntEnum):
    """Says how bad it is; values are those of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong.

    text: for people, with what to do about it.
    event: it has happened, so it stands at once; otherwise it is a state, which may pass.
    key: identifies it whatever figures are in the text; by default the text itself.
    """

    text: str
    level: Level = Level.WARN
    event: bool = False
    key: str = ""


class Settling:
    """Reports findings only after RAISE_REPORTS, and for CLEAR_REPORTS longer than they last."""

    def __init__(self) -> None:
        self._standing: dict[str, _Held] = {}

    def settle(self, found: Iterable[Finding]) -> list[Finding]:
        """Add another report's findings; returns those that stand now, worst first."""
        now = {finding.key or finding.text: finding for finding in found}
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
    """Return the highest level, and the texts of its findings; OK and "" without findings."""
    findings = list(findings)
    level = max((finding.level for finding in findings), default=Level.OK)
    return level, "; ".join(finding.text for finding in findings if finding.level == level)
