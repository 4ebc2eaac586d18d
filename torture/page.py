# SPDX-License-Identifier: Apache-2.0

"""The table of docs/reliability.md, from what each campaign's last full run left."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path

from .outcome import COUNTS, Outcome, from_json, summary, to_json

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
