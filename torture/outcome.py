# SPDX-License-Identifier: Apache-2.0

"""Results: running sums, one row per kind of fault, their summary and the published table."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Self


@dataclass(frozen=True, slots=True)
class Plan:
    """How much to try. quick: seconds instead of minutes. seed: of all random numbers."""

    quick: bool
    seed: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result for one kind of fault.

    fault: what was done, in a few words. times: how often.
    wrong_values: published numbers, times or flags that differ from the truth: of a word, that it
        is another, invented or missed, and not flagged.
    uncounted_losses: frames, samples, packets or messages that were lost without a counter saying
        so, and counted losses that did not happen.
    crashes: unexpected exits, tracebacks and refusals.
    hangs: how often something did not happen in time.
    said: other figures for the table.
    rss_slope_kb_per_h: growth of memory; None where it was not measured.
    """

    fault: str
    times: int
    wrong_values: int = 0
    uncounted_losses: int = 0
    crashes: int = 0
    hangs: int = 0
    said: str = ""
    rss_slope_kb_per_h: float | None = None

    @property
    def good(self) -> bool:
        """Whether all counts that must be 0 are."""
        return not bad(self)


COUNTS = ("wrong_values", "uncounted_losses", "crashes", "hangs")


def bad(found: Outcome | Tally) -> list[str]:
    """Names of the counts that are not 0."""
    return [name for name in COUNTS if getattr(found, name)]


@dataclass
class Tally:
    """Running sums of what the judges find under one kind of fault, to make an Outcome of.

    times: faults injected. frames: published frames or messages. lost: frames not published.
    late: of these, frames that arrived whole, but right after a fault or a start.
    wrong_values … hangs: see Outcome. example: a wrong value. bytes: exposed to faults.
    stamp_errors_s: stamp minus true time of every message, less what no driver could have known.
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
        """The row of the table. said: replaced by the example of a wrong value, if there is one."""
        counts = {name: int(getattr(self, name)) for name in COUNTS}
        return Outcome(fault, self.times, **counts, said=self.example or said)


def summary(outcomes: Iterable[Outcome]) -> str:
    """The last line of `make torture`: the sums, and the fastest growth of memory."""
    outcomes = list(outcomes)
    sums = " ".join(f"{name}={sum(getattr(o, name) for o in outcomes)}" for name in COUNTS)
    slopes = [slope for o in outcomes if (slope := o.rss_slope_kb_per_h) is not None]
    steepest = f"{max(slopes):.0f}" if slopes else "nan"
    return f"faults={sum(o.times for o in outcomes)} {sums} rss_slope_kb_per_h={steepest}"


# ---- the table of docs/reliability.md

DOCS = Path(__file__).resolve().parent.parent / "docs"
RESULTS = DOCS / "reliability.json"
PAGE = DOCS / "reliability.md"
BEGIN, END = "<!-- begin torture -->\n", "<!-- end -->"


def keep(found: dict[str, list[Outcome]], seed: int) -> None:
    """Replace the outcomes of these campaigns in docs/reliability.json, and renew the table."""
    content = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    for name, outcomes in found.items():
        content[name] = {"seed": seed, "outcomes": list(map(asdict, outcomes))}
    text = json.dumps(content, indent=1, ensure_ascii=False)
    text = re.sub(r"\{\n[^{}]*\}", lambda found: re.sub(r"\n *", " ", found[0]), text)
    RESULTS.write_text(text + "\n", encoding="utf-8")
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


def updated(page: str) -> str:
    """The page with a table of all outcomes in docs/reliability.json."""
    before, rest = page.split(BEGIN)
    after = rest.split(END, 1)[1]
    content = json.loads(RESULTS.read_text(encoding="utf-8"))
    found = {name: [Outcome(**row) for row in run["outcomes"]] for name, run in content.items()}
    return before + BEGIN + _table(found) + END + after


def _table(found: dict[str, list[Outcome]]) -> str:
    """A row for each campaign, and one for each of its outcomes that is not good."""
    lines = [
        "| `ONLY=` | kinds of fault | times | wrong | uncounted | crashes | hangs |",
        "|---|--:|--:|--:|--:|--:|--:|",
    ]
    for name, outcomes in found.items():
        lines.append(_row(f"`{name}`", str(len(outcomes)), outcomes))
        bad = (outcome for outcome in outcomes if not outcome.good)
        lines += (_row(f"of which {one.fault}: {one.said}", "1", [one]) for one in bad)
    everything: Iterable[Outcome] = [o for outcomes in found.values() for o in outcomes]
    lines += ["", f"`{summary(everything)}`", ""]
    return "\n".join(lines)


def _row(name: str, what: str, outcomes: Sequence[Outcome]) -> str:
    numbers = (sum(getattr(o, count) for o in outcomes) for count in ("times", *COUNTS))
    return f"| {' | '.join((name, what, *(f'{number:,}' for number in numbers)))} |"
