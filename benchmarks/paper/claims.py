# SPDX-License-Identifier: Apache-2.0

"""A claim of the paper beside what was found here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

REPRODUCED, EXCEEDED, DIFFERS = "reproduced", "exceeded", "differs"
"""What follows from two numbers, of which the one here could have come out otherwise."""
MET = "met"
"""The paper states a property without a number, and what was found here keeps a limit."""
INPUT, NOT_COMPARABLE = "input", "not comparable"
"""The paper's value went in; it was found under other conditions."""
THIS = ""
"""The command of a claim that `make paper` itself computes."""
ASSERTED = "*"
"""Behind where the paper states what it did not measure."""
OF_PAPER: dict[str, Any] = {"color": "0.5", "ls": "--", "lw": 0.9}
"""How a picture shows what the paper states."""
VERDICTS = (REPRODUCED, EXCEEDED, MET, DIFFERS, INPUT, NOT_COMPARABLE)


@dataclass(frozen=True, slots=True)
class Claim:
    """Is a row of docs/paper.md's table.

    where: in the paper. what: with its unit. paper, here: as printed. command: that shows it.
    verdict: one of VERDICTS. why: what differs, or how the number went in.
    """

    where: str
    what: str
    paper: str
    here: str
    command: str
    verdict: str
    why: str = ""

    @property
    def row(self) -> list[str]:
        verdict = f"{self.verdict}: {self.why}" if self.why else self.verdict
        what = f"{self.what} ({self.command})" if self.command else self.what
        return [self.where, what, self.paper, self.here, verdict]


def equals(
    where: str, what: str, paper: float, here: float, command: str, within: float, why: str = ""
) -> Claim:
    """Claim that a number is the paper's. within: share by which it may differ; why: if it does."""
    alike = abs(here / paper - 1) <= within
    verdict, why = (REPRODUCED, "") if alike else (DIFFERS, why)
    return Claim(where, what, f"{paper:g}", f"{here:.4g}", command, verdict, why)


def given(
    where: str, what: str, paper: float, here: float, command: str, within: float, why: str
) -> Claim:
    """Claim that the paper's number, which went in, comes out. within: share it may differ by."""
    verdict, why = (INPUT, why) if abs(here / paper - 1) <= within else (DIFFERS, "")
    return Claim(where, what, f"{paper:g}", f"{here:.3g}", command, verdict, why)


def at_most(where: str, what: str, paper: float, here: float, command: str, why: str = "") -> Claim:
    """Claim that a number is no more than the paper's. why: if there is more."""
    verdict, why = (
        (DIFFERS, why) if here > paper else (EXCEEDED if here < paper else REPRODUCED, "")
    )
    return Claim(where, what, f"{paper:g}", f"{here:.3g}", command, verdict, why)


def keeps(
    where: str, what: str, paper: str, here: float, most: float, command: str, why: str = ""
) -> Claim:
    """Claim a property that the paper names without a number. most: what it means here at most."""
    verdict, why = (MET, f"at most {most:g}" if most else "") if here <= most else (DIFFERS, why)
    return Claim(where, what, paper, f"{here:.3g}", command, verdict, why)
