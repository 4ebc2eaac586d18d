# SPDX-License-Identifier: Apache-2.0

"""What came of a kind of fault, and of all of them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
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
    wrong_values … hangs: see Outcome. example: a wrong value. bytes: that were exposed to faults.
    stamp_errors_s: of every message, stamp minus true time, as far as the driver could know that.
    """

    times: int = 0
    frames: int = 0
    lost: int = 0
    late: int = 0
    bytes: int = 0
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


# ---- the table of docs/reliability.md

DOCS = Path(__file__).resolve().parent.parent / "docs"
RESULTS = DOCS / "reliability.json"
PAGE = DOCS / "reliability.md"
BEGIN, END = "<!-- begin torture -->\n", "<!-- end -->"


def keep(found: dict[str, list[Outcome]], seed: int) -> None:
    """Write the outcomes of these campaigns beside those of the others, and the page's table."""
    content = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    for name, outcomes in found.items():
        content[name] = {"seed": seed, "outcomes": [to_json(outcome) for outcome in outcomes]}
    text = json.dumps(content, indent=1, ensure_ascii=False)
    RESULTS.write_text(text + "\n", encoding="utf-8")
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


def updated(page: str) -> str:
    """The page with the table of the outcomes that were kept."""
    before, rest = page.split(BEGIN)
    after = rest.split(END, 1)[1]
    content = json.loads(RESULTS.read_text(encoding="utf-8"))
    found = {name: list(map(from_json, run["outcomes"])) for name, run in content.items()}
    return before + BEGIN + _table(found) + END + after


def _table(found: dict[str, list[Outcome]]) -> str:
    lines = [
        "| `ONLY=` | what was done | times | wrong | uncounted | crashes | hangs | |",
        "|---|---|--:|--:|--:|--:|--:|---|",
    ]
    lines += [_row(name, outcome) for name, outcomes in found.items() for outcome in outcomes]
    everything: Iterable[Outcome] = [o for outcomes in found.values() for o in outcomes]
    lines += ["", f"`{summary(everything)}`", ""]
    return "\n".join(lines)


def _row(name: str, outcome: Outcome) -> str:
    said = outcome.said
    if not math.isnan(outcome.rss_slope_kb_per_h):
        said = f"{said}; {outcome.rss_slope_kb_per_h:.0f} kB/h".removeprefix("; ")
    counts = " | ".join(str(getattr(outcome, count)) for count in COUNTS)
    cells = (f"`{name}`", outcome.fault, f"{outcome.times:,}", counts, said)
    return f"| {' | '.join(cells)} |".replace("  ", " ")
