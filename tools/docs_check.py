#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Checks the pages by their tests, and prints what these counted: `make docs-check`."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TESTS = ("test_pages.py", "test_page_figures.py", "test_page_blocks.py")
COUNTED = ("pages", "words", "blocks_run", "commands", "false_links", "figures_unproven")


class Counts:
    """Adds up what tests record, and those that fail."""

    def __init__(self) -> None:
        self.sums: Counter[str] = Counter()
        self.failed = 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed += report.failed
        if report.when == "call":
            self.sums.update(dict(report.user_properties))


def main() -> int:
    counts = Counts()
    tests = [str(ROOT / "test" / "unit" / "project" / name) for name in TESTS]
    code = pytest.main(["-q", "-n", "0", "--rootdir", str(ROOT), *tests], plugins=[counts])
    sums = " ".join(f"{name}={counts.sums[name]}" for name in COUNTED)
    failed = counts.failed or int(code != 0)  # pages that could not be looked at, too
    print(f"{sums} failed={failed}")
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
