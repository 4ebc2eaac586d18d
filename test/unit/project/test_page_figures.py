# SPDX-License-Identifier: Apache-2.0

"""Figures of the pages are those of docs/results.json."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[3]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
Record = Callable[[str, object], None]
RESULTS: dict[str, Any] = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
README, RESULTS_PAGE, CONTACTS = "README.md", "docs/results.md", "docs/contacts.md"
Row = list[Any]


def of(benchmark: str, key: str, times: float = 1.0) -> float:
    return float(RESULTS[benchmark]["results"][key]) * times


def small_and_large(benchmark: str, key: str, times: float = 1.0) -> list[float]:
    """At 16 and at 4096 nodes."""
    return [of(benchmark, f"{key}_{nodes}", times) for nodes in (16, 4096)]


def row(benchmark: str, table: int, *begin: object) -> Row:
    """The row of a table that begins so."""
    [found] = [r for r in RESULTS[benchmark]["tables"][table][1:] if r[: len(begin)] == [*begin]]
    return list(found)


def quoted() -> list[tuple[str, str, list[float]]]:
    """Page; a sentence in which {:…} stands for a figure, as it is rounded there; the figures."""
    ros, cpu = small_and_large("ros", "p50_ms"), small_and_large("scale", "cpu", 100)
    error = RESULTS["error"]["tables"][0]
    worst = [max(float(r[column]) for r in error[1:]) for column in (3, 4, 5)]
    paper = [of("error", f"paper_{key}") for key in ("wrong", "lost", "frames")]
    doubt = [of("doubt", key) for key in ("words", "unflagged")]
    flagged = [of("doubt", f"{key}_flagged_share", 100) for key in ("right", "silent")]
    fitted = row("pressure", 0, "fitted")
    drift = [row("pressure", 2, mv) for mv in (3.0, 12.0)]
    chains = [row("pressure", 3, name) for name in ("one curve", "calibrated", "+ tare, drift")]
    contact = {(n, what): row("contact", 4, n, what)[2] / 1e3
               for n, what in ((16, "few"), (4096, "few"), (4096, "all"),
                               (4096, "all, one flickers"))}  # fmt: skip
    max_of_line = max(float(r[1]) for r in error[1:] if not np.isnan(float(r[1])))
    speaking = [
        (told, form, [100 * row("speaking", 0, scene, rule)[at] for rule in ("rest", "change")])
        for told, form, scene, at in (
            ("4,000 taxels, a hug", ".0f", "hug", 2),
            ("… frames with more than they hold", ".0f", "hug", 4),
            ("… somebody walks", ".1f", "walk", 2),
            ("their rest)", ".1f", "day", 2),
        )
    ]
    hertz = [row("contact", 0, "area", "hertz", radius)[3:6] for radius in (1.5, 2.0, 2.5, 4.0)]
    return [
        (README, "{:.1f} ms at 16 nodes, {:.1f} ms at 4096", ros),
        (README, "{:.1f} % of a core at 16 nodes, {:.1f} % at 4096", cpu),
        (README, "{:.0f} wrong words in {:,.0f} frames", [paper[0], paper[2]]),
        (RESULTS_PAGE, "{:.2f} ms (median) at 16 nodes and {:.2f} ms at 4096", ros),
        (RESULTS_PAGE, "{:.0f} messages lost", [of("ros", "lost")]),
        (RESULTS_PAGE, "the whole process costs {:.1f} and {:.1f} % of a core",
         small_and_large("ros", "cpu_node", 100)),
        (RESULTS_PAGE, "finished message alone takes {:.2f} and {:.2f} ms",
         small_and_large("ros", "p50_ms_floor")),
        (RESULTS_PAGE, "{:.1f} % of one core at 16 nodes and 78", cpu[:1]),
        (RESULTS_PAGE, "{:.1f} % at 4096 nodes and 50 frames", cpu[1:]),
        (RESULTS_PAGE, "{:.1f} and {:.1f} % in silence", small_and_large("scale", "silent", 100)),
        (RESULTS_PAGE, "{:.1f} ms at 4096 nodes with chips", [of("scale", "latency_ms_4096")]),
        (RESULTS_PAGE, "{:.2f} dB more than the bound", [of("error", "loss_db")]),
        (RESULTS_PAGE, "{:.2f} dB at 4 samples per chip, {:.2f} dB with the amplifier clipping "
         "at 3·√n·A, {:.2f} dB", worst),
        (RESULTS_PAGE, "{:.0f} words were wrong and {:.0f} frames lost in {:,.0f} frames", paper),
        (RESULTS_PAGE, "in {:.2f} ms: with so much noise", [of("pareto", "default_us", 1e-3)]),
        (RESULTS_PAGE, "Of {:,.0f} words", doubt[:1]),
        (RESULTS_PAGE, "conditions, {:.0f} were false without a flag", doubt[1:]),
        (RESULTS_PAGE, "{:.2f} % of the right words and {:.2f} % of the true silences", flagged),
        (RESULTS_PAGE, "error rate of up to {:.2f} to {:.2f}",
         [of("timing", "plain_ber"), of("timing", "resync_ber")]),
        *((RESULTS_PAGE, f"{scene} | {{:{form}}} % | {{:{form}}} % |", shares)
          for scene, form, shares in speaking),
        (RESULTS_PAGE, "({:.0f} % if nodes did not", [of("speaking", "day_share_fixed", 100)]),
        (RESULTS_PAGE, "each read by itself, need {:.2f} dB", [max_of_line]),
        (RESULTS_PAGE, "in {:.2f} of the time of a C transform", [of("speed", "vs_c_4096")]),
        (RESULTS_PAGE, "costs {:.0f} % of a full one at 16 nodes, {:.0f} % at 1024 and {:.0f} %",
         [of("skip", f"idle_ratio_{n}", 100) for n in (16, 1024, 4096)]),
        (RESULTS_PAGE, "the simulated error is {:.2f} times", [max(map(float, fitted[1:]))]),
        (RESULTS_PAGE, "it is {:.0f} and {:.0f} times", row("pressure", 0, "default curve")[1:]),
        (RESULTS_PAGE, "Drift of {:.0f} Pa/min at rest leaves {:.0f} Pa rms instead of {:.0f}",
         [drift[0][i] for i in (1, 3, 2)]),
        (RESULTS_PAGE, "at {:.0f} Pa/min {:.0f} instead of {:.0f} Pa",
         [drift[1][i] for i in (1, 3, 2)]),
        (RESULTS_PAGE, "{:.1f} kPa rms with one curve, {:.1f} with calibrated curves and {:.1f}",
         [chain[1] / 1e3 for chain in chains]),
        (RESULTS_PAGE, "in {:.0f}, {:.0f} and {:.0f} µs per frame", [chain[2] for chain in chains]),
        (RESULTS_PAGE, "{:.2f} ms per frame at 16 taxels and {:.2f} ms at 4096, all 4096 taxels "
         "touched {:.2f} ms, or {:.2f} ms", list(contact.values())),
        (RESULTS_PAGE, "takes {:.2f} ms at 16 taxels and {:.1f} ms",
         small_and_large("pictures", "us_heatmap", 1e-3)),
        (RESULTS_PAGE, "points {:.2f} and {:.2f} ms",
         small_and_large("pictures", "us_points", 1e-3)),
        (RESULTS_PAGE, "squares {:.2f} ms at 16 taxels and {:.2f} ms at 256",
         [of("pictures", f"us_markers_{n}", 1e-3) for n in (16, 256)]),
        (RESULTS_PAGE, "contacts cost {:.1f} % of a core and are {:.1f} ms",
         [of("body", "percent_contacts"), of("body", "p50_ms_contacts")]),
        (RESULTS_PAGE, "as well {:.1f} % and {:.1f} ms",
         [of("body", "percent_both_4096"), of("body", "p50_ms_both_4096")]),
        *((CONTACTS, f"| {radius} | {{:.1f}}, {{:.1f}}, {{:.1f}} %", figures)
          for radius, figures in zip(("1.5", "2", "2.5", "4"), hertz, strict=True)),
    ]  # fmt: skip


@pytest.mark.parametrize(("page", "sentence", "figures"), quoted())
def test_a_page_quotes_the_last_run(
    page: str, sentence: str, figures: list[float], record_property: Record
) -> None:
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    is_there = sentence.format(*figures) in text
    record_property("figures_unproven", int(not is_there))
    assert is_there


def test_the_page_tells_of_wrong_words_of_broken_nodes_and_of_the_longest_run_in_real_time() -> (
    None
):
    page = " ".join((ROOT / "docs" / "reliability.md").read_text(encoding="utf-8").split())
    kept = json.loads((ROOT / "docs" / "reliability.json").read_text(encoding="utf-8"))
    said = {name: " ".join(o["said"] for o in run["outcomes"]) for name, run in kept.items()}
    broken = re.findall(r"([\d,]+) wrong of the broken nodes, not flagged", said["signals"])
    assert f"{sum(int(count.replace(',', '')) for count in broken):,} words of broken nodes" in page
    [(grew, spread)] = re.findall(r"(\d+) ± (\d+) kB/h", said["soak"])
    assert f"{int(grew):,} ± {int(spread):,} kB/h" in page
    [seconds] = re.findall(r"^(\d+) s in real time", kept["soak"]["outcomes"][0]["fault"])
    assert f"{seconds} s, in which memory" in page


GIVEN = {
    "error": {"10": "of 10⁻³", "11": "largest stretch, %; dB that a lone frame takes"},
    "doubt": {
        "60": "frames of the picture",
        "303": "mixtures",
        "15.9": "silences",
        "0.15": "of an amplitude",
    },
    "timing": {"11": "largest stretch, %", "0.05": "%, of 256 nodes", "32": "chips of a restart"},
    "sparse": {"15": "ρ", "900": "nodes compared with"},
    "speaking": {"4,000": "taxels", "400": "taxels of a day"},
    "skip": {"1023": "nodes of order 1024"},
    "loss": {"8": "turns"},
    "scale": {"78": "frames per second of 12.8 ms"},
    "batch": {"24": "taxels"},
    "rivals": {"4": "taxels a side", "0.2": "kg", "1.4.5": "version", "4.0.0": "version"},
    "edge": {"4": "taxels a side", "1": "mm"},
}
"""Numbers of docs/results.md that went into a benchmark, and are no result of it."""
FACTORS = (1, 100, 1e-3, 1e3, 1e-6, 1e6)
"""Between a result and its figure on the page: shares in %, other units."""
NUMBER = re.compile(r"(?<![\w.⁻−-])\d[\d,]*(?:\.\d+)?(?!\w)")


def kept_numbers(value: object) -> Iterator[float]:
    """Yield all numbers in an entry of results.json, those in its texts too."""
    if isinstance(value, str):
        yield from map(float, re.findall(r"\d+(?:\.\d+)?", value))
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from kept_numbers(item)
    elif isinstance(value, int | float):
        yield float(value)


def sections() -> list[tuple[str, str]]:
    """The sections of docs/results.md whose benchmark has results: its name, and the text."""
    parts = re.split(r"^## ", (ROOT / RESULTS_PAGE).read_text(encoding="utf-8"), flags=re.M)[1:]
    named = [(re.search(r"make bench-(\w+)", part.partition("\n")[0]), part) for part in parts]
    return [(match[1], part.partition("\n")[2]) for match, part in named if match]


@pytest.mark.parametrize(("name", "text"), sections(), ids=[name for name, _ in sections()])
def test_every_figure_is_one_of_its_benchmark(
    name: str, text: str, record_property: Record
) -> None:
    known = list(kept_numbers([RESULTS[name]["results"], RESULTS[name]["tables"]]))
    unproven = []
    for figure in NUMBER.findall(re.sub(r"!\[.*?\)|\]\([^)]*\)|`[^`]*`", " ", text)):
        value, digits = float(figure.replace(",", "")), len(figure.partition(".")[2])
        rounded = (round(one * factor, digits) for one in known for factor in FACTORS)
        is_kept = any(abs(one - value) < 1e-3 * 10**-digits for one in rounded)
        if not is_kept and figure.strip(",") not in GIVEN.get(name, {}):
            unproven.append(figure)
    record_property("figures_unproven", len(unproven))
    assert unproven == []


def test_make_help_tells_how_long_benchmarks_take() -> None:
    seconds = {name: run["seconds"] for name, run in RESULTS.items() if name != "paper"}
    least, most = min(seconds, key=lambda n: seconds[n]), max(seconds, key=lambda n: seconds[n])
    text = f"from {seconds[least]:.0f} s ({least}) to {seconds[most] / 60:.0f} min ({most}"
    assert text in MAKEFILE
    [names] = re.findall(r"NAME: ([^;]*);", MAKEFILE.replace("\n#", " "))
    assert set(re.findall(r"\w+", names)) == set(seconds)


def test_every_benchmark_was_run_in_full_and_says_where() -> None:
    assert [name for name, run in RESULTS.items() if run["quick"]] == []
    assert all(run["machine"]["cpu"] for run in RESULTS.values())
