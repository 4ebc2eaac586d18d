# SPDX-License-Identifier: Apache-2.0

"""Long work says how far it has come, short work nothing."""

import math

import pytest

from tactile_cdma.datasets import progress


def test_reports_come_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s)
    with progress.Progress() as reports:
        for _ in range(25):
            now_s += 1.0
            reports.at((now_s - 100) / 50, "touch.mcap")
        now_s += progress.LOG_S
        reports.at(math.nan, "of unknown length")
    assert capsys.readouterr().err.splitlines() == [
        " 20% touch.mcap",
        " 40% touch.mcap",
        "of unknown length",
    ]
