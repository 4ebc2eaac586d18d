"""What the doctor finds, and how it is told. Standard library only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How bad it is: nothing to do, may cause trouble, will not work."""

    OK = "ok"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at. text: what was found, and unless all is well what to do."""

    level: Level
    subject: str
    text: str


def ok(subject: str, text: str) -> Finding:
    """All is well."""
    return Finding(Level.OK, subject, text)


def warning(subject: str, text: str) -> Finding:
    """It may cause trouble."""
    return Finding(Level.WARNING, subject, text)


def problem(subject: str, text: str) -> Finding:
    """It does not work like this."""
    return Finding(Level.PROBLEM, subject, text)


def line(finding: Finding) -> str:
    """A finding for people."""
    return f"{finding.level:<8} {finding.subject}: {finding.text}"


def summary(findings: Sequence[Finding]) -> str:
    """The last line."""
    count = {level: sum(f.level is level for f in findings) for level in Level}
    return (
        f"{_counted(count[Level.PROBLEM], 'problem')}, "
        f"{_counted(count[Level.WARNING], 'warning')}, {count[Level.OK]} ok"
    )


def exit_code(findings: Sequence[Finding]) -> int:
    """1 where there is a problem."""
    return int(any(finding.level is Level.PROBLEM for finding in findings))


def _counted(number: int, what: str) -> str:
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"
