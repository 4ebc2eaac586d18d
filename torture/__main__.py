# SPDX-License-Identifier: Apache-2.0

"""`make torture`: runs the campaigns, prints a row per kind of fault, and sums in the last line."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from subprocess import DEVNULL, PIPE
from tempfile import TemporaryDirectory

from .outcome import Outcome, Plan, keep, summary

CAMPAIGNS = {  # name: time limit of a full run, s; the longest campaign first
    "day": 1500,
    "soak": 1200,
    "load": 1200,
    "connection": 900,
    "line": 900,
    "signals": 900,
    "fuzz": 900,
    "calls": 900,
    "files": 900,
    "hosts": 900,
}
QUICK_S = 400
"""Time limit of a quick campaign, s. Chosen: ten times what one takes on a quiet machine."""
WIDTH = 58


def main() -> int:
    """Run the campaigns asked for; exit code 1 if any count that must be 0 is not."""
    parser = argparse.ArgumentParser(prog="python -m torture", description=__doc__)
    parser.add_argument("campaign", nargs="*", choices=[*CAMPAIGNS, []], help="default: all")
    parser.add_argument("--quick", action="store_true", default=os.environ.get("QUICK", "0") != "0")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--json",
        type=Path,
        help="write the outcomes of the campaigns here, and run them in this process",
    )
    arguments = parser.parse_args()
    plan = Plan(arguments.quick, arguments.seed)
    names: Sequence[str] = arguments.campaign or list(CAMPAIGNS)
    if arguments.json:
        rows = [asdict(outcome) for name in names for outcome in _run(name, plan)]
        arguments.json.write_text(json.dumps(rows))
        return 0
    started = time.monotonic()
    found = _in_processes(names, plan)
    outcomes = [outcome for name in names for outcome in found[name]]
    if not plan.quick:
        keep(found, plan.seed)
    print(f"{time.monotonic() - started:.0f} s, seed {plan.seed}")
    print(summary(outcomes))
    return int(not all(outcome.good for outcome in outcomes))


def _run(name: str, plan: Plan) -> Iterator[Outcome]:
    module = "torture.load.soak" if name == "soak" else f"torture.{name}.campaign"
    outcomes: Iterator[Outcome] = importlib.import_module(module).run(plan)
    yield from outcomes


def _in_processes(names: Sequence[str], plan: Plan) -> dict[str, list[Outcome]]:
    """Run every campaign in its own process, one per core at a time."""
    with TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        futures = {name: pool.submit(_in_process, name, plan, Path(folder)) for name in names}
        return {name: futures[name].result() for name in names}


def _in_process(name: str, plan: Plan, folder: Path) -> list[Outcome]:
    file = folder / f"{name}.json"
    limit_s = QUICK_S if plan.quick else CAMPAIGNS[name]
    command = [sys.executable, "-m", "torture", name, "--seed", str(plan.seed), "--json", str(file)]
    command += ["--quick"] if plan.quick else []
    # Its own session, so that all its processes can be killed with it.
    process = subprocess.Popen(
        command, stdout=DEVNULL, stderr=PIPE, text=True, start_new_session=True
    )
    try:
        _, complaint = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        outcomes = [Outcome(f"{name}: not over after {limit_s} s", 0, hangs=1)]
    else:
        if process.returncode:
            outcomes = [Outcome(f"{name}: ended with {process.returncode}", 0, crashes=1)]
        else:
            outcomes = [Outcome(**row) for row in json.loads(file.read_text())]
        if not all(outcome.good for outcome in outcomes):
            sys.stderr.write(complaint)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    for outcome in outcomes:
        print(_line(name, outcome), flush=True)
    return outcomes


def _line(name: str, outcome: Outcome) -> str:
    bad = "" if outcome.good else f"  {summary([outcome])}"
    return f"{name:<11} {outcome.times:>9,} × {outcome.fault:<{WIDTH}} {outcome.said}{bad}".rstrip()


if __name__ == "__main__":
    sys.exit(main())
