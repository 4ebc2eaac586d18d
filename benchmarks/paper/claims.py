# SPDX-License-Identifier: Apache-2.0

"""A claim of the paper beside what was found here."""

from __future__ import annotations

from dataclasses import dataclass

REPRODUCED, EXCEEDED, DIFFERS, MISSING = "reproduced", "exceeded", "differs", "missing"


@dataclass(frozen=True, slots=True)
class Claim:
    """Is a row of docs/paper.md's table.

    where: in the paper. what: with its unit. paper, here: as printed. command: that shows it.
    verdict: one of the four above. why: where it differs.
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
        return [self.where, self.what, self.paper, self.here, self.command, verdict]


def equals(
    where: str, what: str, paper: float, here: float, command: str, within: float, why: str = ""
) -> Claim:
    """Claim that a number is the paper's. within: share by which it may differ; why: if it does."""
    alike = abs(here / paper - 1) <= within
    verdict, why = (REPRODUCED, "") if alike else (DIFFERS, why)
    return Claim(where, what, f"{paper:g}", f"{here:.4g}", command, verdict, why)


def at_most(where: str, what: str, paper: float, here: float, command: str, why: str = "") -> Claim:
    """Claim that a number is no more than the paper's. why: if there is more."""
    verdict, why = (EXCEEDED, "") if here <= paper else (DIFFERS, why)
    return Claim(where, what, f"{paper:g}", f"{here:.3g}", command, verdict, why)


def says(where: str, what: str, paper: str, here: str, command: str) -> Claim:
    """Claim that a text is the paper's."""
    return Claim(where, what, paper, here, command, REPRODUCED if here == paper else DIFFERS)
