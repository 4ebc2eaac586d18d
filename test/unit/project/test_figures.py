# SPDX-License-Identifier: Apache-2.0

"""Figures of benchmarks that the pages quote are those of docs/results.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]
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
    hertz = [row("contact", 0, "area", "hertz", radius)[3:6] for radius in (1.5, 2.0, 2.5, 4.0)]
    return [
        (README, "{:.1f} ms at 16 nodes, {:.1f} ms at 4096", ros),
        (README, "{:.1f} % of a core at 16 nodes, {:.1f} % at 4096", cpu),
        (README, "{:.0f} wrong words in {:,.0f} frames", [paper[0], paper[2]]),
        (RESULTS_PAGE, "{:.2f} ms (median) at 16 nodes and {:.2f} ms at 4096", ros),
        (RESULTS_PAGE, "{:.0f} messages lost", [of("ros", "lost")]),
        (RESULTS_PAGE, "the whole process costs {:.1f} and {:.1f} % of a core",
         small_and_large("ros", "cpu_node", 100)),
        (RESULTS_PAGE, "finished message takes {:.2f} and {:.2f} ms",
         small_and_large("ros", "p50_ms_floor")),
        (RESULTS_PAGE, "{:.1f} % of one core at 16 nodes and 78", cpu[:1]),
        (RESULTS_PAGE, "{:.1f} % at 4096 nodes and 50 frames", cpu[1:]),
        (RESULTS_PAGE, "{:.1f} and {:.1f} % in silence", small_and_large("scale", "silent", 100)),
        (RESULTS_PAGE, "costs {:.1f} % whatever the driver does", [of("scale", "floor_4096", 100)]),
        (RESULTS_PAGE, "{:.1f} ms at 4096 nodes with chips", [of("scale", "latency_ms_4096")]),
        (RESULTS_PAGE, "{:.2f} ms per frame at 16", [of("scale", "replay_us_16", 1e-3)]),
        (RESULTS_PAGE, "has the power {:.2f} from 1024", [of("scale", "exponent")]),
        (RESULTS_PAGE, "{:.2f} dB more than the bound", [of("error", "loss_db")]),
        (RESULTS_PAGE, "{:.2f} dB at 4 samples per chip, {:.2f} dB with the amplifier clipping "
         "at 3·√n·A, {:.2f} dB", worst),
        (RESULTS_PAGE, "{:.0f} words were wrong and {:.0f} frames lost in {:,.0f} frames", paper),
        (RESULTS_PAGE, "in {:.2f} ms. Frames found", [of("pareto", "default_us", 1e-3)]),
        (RESULTS_PAGE, "Of {:,.0f} words", doubt[:1]),
        (RESULTS_PAGE, "conditions, {:.0f} were false without a flag", doubt[1:]),
        (RESULTS_PAGE, "{:.2f} % of the right words and {:.2f} % of the true silences", flagged),
        (RESULTS_PAGE, "error rate of up to {:.2f} to {:.2f}",
         [of("timing", "plain_ber"), of("timing", "resync_ber")]),
        (RESULTS_PAGE, "in {:.2f} of the time of a C transform", [of("speed", "vs_c_4096")]),
        (RESULTS_PAGE, "costs {:.0f} % of a full one at 16 nodes, {:.0f} % at 1024 and {:.0f} %",
         [of("skip", f"idle_ratio_{n}", 100) for n in (16, 1024, 4096)]),
        (RESULTS_PAGE, "the error is {:.2f} times", [max(map(float, fitted[1:]))]),
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
def test_a_page_quotes_the_last_run(page: str, sentence: str, figures: list[float]) -> None:
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    assert sentence.format(*figures) in text


def test_every_benchmark_was_run_in_full_and_says_where() -> None:
    assert [name for name, run in RESULTS.items() if run["quick"]] == []
    assert all(run["machine"]["cpu"] for run in RESULTS.values())
