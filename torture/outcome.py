# SPDX-License-Identifier: Apache-2.0

"""What came of a kind of fault, and of all of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from typing import Self


@dataclass(frozen=True, slots=True)
class Plan:
    """How much to try. quick: seconds instead of minutes. seed: of everything random."""

    quick: bool
    seed: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of one kind of fault.

    fault: what was done, in a few words. times: how often.
    wrong_values: published numbers, times or flags that are not what really was.
    uncounted_losses: frames, samples, packets or messages lost that no counter told of, and losses
        counted that were none.
    crashes: ends, tracebacks and refusals that should not have been.
    hangs: times that something did not go on in time.
    said: what else is worth telling, for the table.
    rss_slope_kb_per_h: growth of memory; NaN where it was not measured.
    """

    fault: str
    times: int
    wrong_values: int = 0
    uncounted_losses: int = 0
    crashes: int = 0
    hangs: int = 0
    said: str = ""
    rss_slope_kb_per_h: float = math.nan

    @property
    def good(self) -> bool:
        """Nothing happened that must not happen."""
        return not (self.wrong_values or self.uncounted_losses or self.crashes or self.hangs)


COUNTS = ("wrong_values", "uncounted_losses", "crashes", "hangs")


@dataclass
class Tally:
    """Running sums of what the judges find under one kind of fault; an Outcome is made of it.

    times: faults put in. frames: frames or messages that were published. lost: those that were not.
    late: whole frames, right after a fault or a start, that were not published either.
    wrong_values … hangs: see Outcome. example: a wrong value. stamp_errors_s: of every message,
    its stamp minus the true time.
    """

    times: int = 0
    frames: int = 0
    lost: int = 0
    late: int = 0
    wrong_values: int = 0
    uncounted_losses: int = 0
    crashes: int = 0
    hangs: int = 0
    example: str = ""
    stamp_errors_s: list[float] = field(default_factory=list)

    def __iadd__(self, other: Self) -> Self:
        for item in fields(self):
            setattr(self, item.name, getattr(self, item.name) + getattr(other, item.name))
        return self

    def outcome(self, fault: str, said: str = "") -> Outcome:
        """The row of the table. said: unless there is an example of what is wrong."""
        counts = {name: int(getattr(self, name)) for name in COUNTS}
        return Outcome(fault, self.times, **counts, said=self.example or said)


def summary(outcomes: Iterable[Outcome]) -> str:
    """The last line of `make torture`: sums, and the steepest growth of memory."""
    outcomes = list(outcomes)
    sums = " ".join(f"{name}={sum(getattr(o, name) for o in outcomes)}" for name in COUNTS)
    slopes = [slope for o in outcomes if not math.isnan(slope := o.rss_slope_kb_per_h)]
    steepest = f"{max(slopes):.0f}" if slopes else "nan"
    return f"faults={sum(o.times for o in outcomes)} {sums} rss_slope_kb_per_h={steepest}"


def to_json(outcome: Outcome) -> dict[str, object]:
    """An outcome as json.dumps takes it; NaN is None."""
    content = asdict(outcome)
    if math.isnan(outcome.rss_slope_kb_per_h):
        content["rss_slope_kb_per_h"] = None
    return content


def from_json(content: dict[str, object]) -> Outcome:
    """The outcome that to_json was given."""
    values = {name: math.nan if value is None else value for name, value in content.items()}
    return Outcome(**values)  # type: ignore[arg-type]
