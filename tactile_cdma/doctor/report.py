# SPDX-License-Identifier: Apache-2.0

"""The doctor's checks and their wording. Standard library only."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial


class Grade(StrEnum):
    """Nothing to do; may cause trouble; will not work."""

    OK = "ok"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was checked. text: what was found and, unless all is well, what to do."""

    verdict: Grade
    subject: str
    text: str


ok = partial(Check, Grade.OK)
warning = partial(Check, Grade.WARNING)
problem = partial(Check, Grade.PROBLEM)


def line(check: Check) -> str:
    """A check as a line of text."""
    return f"{check.verdict:<8} {check.subject}: {check.text}"


def summary(checks: Sequence[Check]) -> str:
    """The last line."""
    count = {verdict: sum(c.verdict is verdict for c in checks) for verdict in Grade}
    return (
        f"{_counted(count[Grade.PROBLEM], 'problem')}, "
        f"{_counted(count[Grade.WARNING], 'warning')}, {count[Grade.OK]} ok"
    )


def exit_code(checks: Sequence[Check]) -> int:
    """1 where there is a problem."""
    return int(any(check.verdict is Grade.PROBLEM for check in checks))


def _counted(number: int, what: str) -> str:
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"
