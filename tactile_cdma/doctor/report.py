# SPDX-License-Identifier: Apache-2.0

"""The doctor's checks. Standard library only."""

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
