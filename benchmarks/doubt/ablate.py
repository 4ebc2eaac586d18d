# SPDX-License-Identifier: Apache-2.0

"""What every constant of the heart is worth: the price of its absence, in the conditions here.

    .venv/bin/python -m benchmarks.doubt --ablate
        --only LEFT     constants with this in module and name: stray.LEFT
        --frames 30     of each condition
        --every 1       all conditions; 4: every fourth one of each kind
        --groups        constants without a price alone are then tried together, in all conditions

A constant is taken away by a value at which it decides nothing more: a millionth and a million
times what it is, or what OFF says; one of them switches its rule off, and the other one has it
always hold. Each is tried in a process of its own (`trial`), and has a row; a constant's price is
the lower one. Where one value has none, the constant can go, as far as these conditions tell: such
ones are tried together, as one rule may hide that another one is needed.

Prices are what becomes worse than without a change:
- false: claims without a flag, of any kind (`Tally.false`);
- flagged, silent flagged: right words, and silences, on sound lines;
- lost: words of frames that were not found, or rejected.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

from tools.constants import ROOT, Constant, heart

from .tally import total
from .trial import Overrides, Run, Task, TrialError, try_out

BIG, MANY = 1e6, 1000
"""Factors: of numbers, and of whole ones, which are counts."""
FRAMES, EVERY = 24, 4
"""Frames of a condition, and one of how many conditions, by which constants are ranked."""
SLOWEST_S = 0.3
"""Conditions that take longer, s, are left out: ten of them take as long as all others."""
SLOWER, LEAST_S = 6.0, 20.0
"""A trial has failed when it takes so many times what it takes without a change, and so long, s of
the processor."""
FALSE = 100
"""Right words that may be flagged instead of one that is false: what orders the rows."""
NAMED = 3
"""Conditions that a row names."""
OFF: dict[str, tuple[float, ...]] = {}
"""Values at which a constant decides nothing more, where a millionth and a million times do not say
that; none for what is no rule, but a definition or a size of memory."""
NO_RULES = (
    *("codes.", "frame.", "sparse.MOST_NODES", "sparse.ORDERS", "sparse.MIXER"),
    "search.CELLS",
)
"""Begins of names of what is no rule: shapes of codes and frames, sizes, and numbers of cases."""
IN_C = re.compile(r"^#define +([A-Z_]+) +([0-9]+\.[0-9.e+-]+)", re.MULTILINE)
"""A number that C alone has. It is not tried."""


class Price(NamedTuple):
    """What is worse without a constant; below 0: better."""

    false: int
    flagged: int
    silent_flagged: int
    lost: int

    @property
    def cost(self) -> int:
        """What orders prices."""
        return FALSE * self.false + self.flagged + self.silent_flagged + self.lost

    @property
    def is_seen(self) -> bool:
        """Whether there is one."""
        return self.false > 0 or self.flagged + self.silent_flagged + self.lost > 0


@dataclass(frozen=True)
class Row:
    """A constant with another value: its price, and where; or why there is none."""

    constant: Constant
    value: float
    price: Price | None
    where: str

    @property
    def cost(self) -> float:
        return self.price.cost if self.price else float("inf")


class Bench:
    """Tries values in some conditions, and compares with what comes of them without a change."""

    def __init__(self, store: str, frames: int, seed: int = 0) -> None:
        self._store, self._frames, self._seed = store, frames, seed
        self._names: Sequence[str] = ()
        self._most_s = Task.most_s
        self.before: Mapping[str, Run] = {}

    def choose(self, every: int) -> None:
        """Take one of so many conditions of each kind; those that are slow, or false, never."""
        self._names = ()
        runs = self._try({})
        fast = [name for name, run in runs.items() if run.seconds < SLOWEST_S]
        self._names = sampled([name for name in fast if not runs[name].tally.false], every)
        self.before = self._try({})
        self._most_s = round(
            max(LEAST_S, SLOWER * sum(run.seconds for run in self.before.values()))
        )

    def price(self, overrides: Overrides) -> tuple[Price | None, str]:
        """What other values cost, and where most of it, or why they do not work."""
        try:
            after = self._try(overrides)
        except TrialError as why:
            return None, str(why)
        prices = {name: price(run, after[name]) for name, run in self.before.items()}
        dear = sorted(
            (name for name in prices if prices[name].is_seen), key=lambda n: -prices[n].cost
        )
        dear.sort(key=lambda name: -prices[name].false)
        more = f", {len(dear) - NAMED} more" if len(dear) > NAMED else ""
        return summed(prices.values()), "; ".join(dear[:NAMED]) + more

    def _try(self, overrides: Overrides) -> dict[str, Run]:
        return try_out(
            Task(self._store, self._names, self._frames, self._seed, overrides, self._most_s)
        )


def price(before: Run, after: Run) -> Price:
    """Compute the price in one condition."""
    is_sound, was, now = not before.rough, before.tally, after.tally
    return Price(
        now.false - was.false,
        (now.flagged - was.flagged) * is_sound,
        (now.silent_flagged - was.silent_flagged) * is_sound,
        now.lost - was.lost,
    )


def summed(prices: Iterable[Price]) -> Price:
    """Add up the prices in several conditions."""
    return Price(*map(sum, zip(*prices, strict=True)))


def sampled(names: Sequence[str], every: int) -> list[str]:
    """One of so many names of each kind, of every kind other ones of their tables."""
    kinds: dict[str, list[str]] = {}
    for name in names:
        kinds.setdefault(kind(name), []).append(name)
    return [name for at, some in enumerate(kinds.values()) for name in some[at % every :: every]]


def kind(name: str) -> str:
    """Source and timing: "marks", or "mixture means"."""
    first, rest = name.split(": ", 1)
    return f"mixture {rest.split(',')[0]}" if first.startswith("mixture") else first


def values(constant: Constant) -> list[float]:
    """Return values that take a constant away; none of what is no rule."""
    if constant.title.startswith(NO_RULES):
        return []
    if constant.title in OFF:
        return list(OFF[constant.title])
    was = constant.value
    both: tuple[float, ...] = (was / BIG, was * BIG)
    if isinstance(was, int):
        both = 0, was * MANY
    return [value for value in both if value != was]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ablate", action="store_true", help="this")
    parser.add_argument("--only", default="", help="constants with this in MODULE.NAME")
    parser.add_argument("--frames", type=int, default=FRAMES, help="of each condition")
    parser.add_argument("--every", type=int, default=EVERY, help="1: all conditions")
    parser.add_argument("--seed", type=int, default=0, help="other recordings")
    parser.add_argument("--groups", action="store_true", help="try together what has no price")
    options = parser.parse_args()
    chosen = [one for one in heart() if options.only in one.title]
    with tempfile.TemporaryDirectory() as store:
        bench = Bench(store, options.frames, options.seed)
        bench.choose(options.every)
        was = total(run.tally for run in bench.before.values())
        print(f"{len(bench.before)} conditions, {was.words} words, {was.silences} silences")
        rows = rank(bench, chosen)
        report(rows)
        for constant in chosen:
            if not values(constant):
                print(f"not tried, for it is no rule: {constant.title} = {constant.value:g}")
        for path in sorted((ROOT / "kernel").glob("*.[ch]")):
            for name, text in IN_C.findall(path.read_text(encoding="utf-8")):
                print(f"not tried, for C alone has it: {path.name}: {name} = {text}")
        if options.groups:
            bench.choose(1)
            free = [row for row in cheapest(rows) if row.price and not row.price.is_seen]
            free.sort(key=lambda row: chosen.index(row.constant))  # rules of a file are halved last
            print("without a price together:")
            for row in together(bench, free):
                print(_line(row))


def rank(bench: Bench, constants: Sequence[Constant]) -> list[Row]:
    """All values of all constants, each alone; prints them as they come."""

    def row(one: tuple[Constant, float]) -> Row:
        constant, value = one
        found = Row(constant, value, *bench.price({constant.module: {constant.name: value}}))
        print(_line(found), flush=True)
        return found

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return list(pool.map(row, ((one, value) for one in constants for value in values(one))))


def cheapest(rows: Sequence[Row]) -> list[Row]:
    """The cheaper value of each constant, the dearest constants first."""
    best: dict[Constant, Row] = {}
    for row in sorted(rows, key=lambda row: row.cost):
        best.setdefault(row.constant, row)
    return sorted(best.values(), key=lambda row: -row.cost)


def report(rows: Sequence[Row]) -> None:
    """One line for each constant, the dearest first."""
    best = cheapest(rows)
    without = [row for row in best if row.price and not row.price.is_seen]
    print(f"\n{len(best)} constants, {len(without)} without a price; of each the cheaper value")
    print(_HEADER)
    for row in best:
        print(_line(row))
    print()


def together(bench: Bench, rows: Sequence[Row]) -> list[Row]:
    """Which of those that have no price alone have none together, in all conditions.

    A group that has one is halved, until it is a single constant: that has a price in company.
    """
    gone: list[Row] = []

    def drop(group: Sequence[Row]) -> None:
        overrides: dict[str, dict[str, float]] = {}
        for row in (*gone, *group):
            overrides.setdefault(row.constant.module, {})[row.constant.name] = row.value
        found, where = bench.price(overrides)
        if found and not found.is_seen:
            gone.extend(group)
            print(f"together without a price: {len(gone)}", flush=True)
        elif len(group) == 1:
            row = replace(group[0], price=found, where=where)
            print(f"in company: {_line(row)}", flush=True)
        else:
            drop(group[: len(group) // 2])
            drop(group[len(group) // 2 :])

    if rows:
        drop(rows)
    return gone


_HEADER = f"{'constant':34} {'is':>9} {'tried':>9}  false flagged  silent   lost  where, or why not"


def _line(row: Row) -> str:
    """A row as text."""
    begin = f"{row.constant.title:34} {row.constant.value:9.4g} {row.value:9.4g}"
    if row.price is None:
        return f"{begin} fails: {row.where}"
    false, flagged, silent, lost = row.price
    end = f"  {row.where}" if row.price.is_seen else "  no price seen"
    return f"{begin} {false:6} {flagged:7} {silent:7} {lost:6}{end}"
