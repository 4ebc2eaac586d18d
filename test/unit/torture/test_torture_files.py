# SPDX-License-Identifier: Apache-2.0

"""A short run of the campaign with odd files, and the defects that it must find."""

import random
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from torture.files import campaign
from torture.files.readers import READERS, Reader

SMALL = 1 << 16


def some(*names: str) -> dict[str, Reader]:
    found = {name: READERS[name] for name in names}
    campaign.warm(found)
    return found


@pytest.mark.parametrize("kind", campaign.ODD)
def test_odd_files_are_read_or_refused(kind: str) -> None:
    readers = some("loads", "urdf", "metadata", "sqlite", "info")
    outcome = campaign.tried(kind, readers, campaign.ODD[kind])
    assert outcome.good and outcome.times == len(readers)


def test_large_files_are_read_or_refused_and_signals_end_it() -> None:
    readers = some("loads", "scope", "mcap", "parameters")
    assert campaign.tried("many", readers, partial(campaign.large, SMALL)).good
    rng = random.Random(1)
    for number in (signal.SIGINT, signal.SIGTERM):
        assert campaign.interrupted(number, readers, SMALL, 0.05, rng).good


def hangs_in_c(path: Path) -> None:
    """Open a file as no door would: a pipe has nobody at its other end."""
    path.open("rb").read(1)


def fills_the_memory(path: Path) -> None:
    np.ones(1 << 28).sum()


def swallows(path: Path) -> None:
    for _ in range(99):
        try:
            time.sleep(1.0)
        except KeyboardInterrupt:
            continue


@pytest.mark.parametrize(
    ("read", "count"),
    [(hangs_in_c, "hangs"), (fills_the_memory, "crashes"), (lambda path: 1 / 0, "crashes")],
)
def test_a_reader_that_hangs_crashes_or_takes_too_much_is_found(
    monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], object], count: str
) -> None:
    monkeypatch.setattr(campaign, "LONGEST_WAIT_S", 2.0)
    bad = {"bad": replace(READERS["loads"], read=read)}
    outcome = campaign.tried("a pipe", bad, campaign.ODD["a pipe"])
    assert getattr(outcome, count) == 1


def test_a_reader_that_no_signal_ends_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "END_S", 1.0)
    monkeypatch.setattr(campaign, "large", lambda most, path, reader: path.touch())
    bad = {"bad": replace(READERS["loads"], read=swallows)}
    for number in (signal.SIGINT, signal.SIGTERM):
        late = random.Random(1)
        monkeypatch.setattr(late, "uniform", lambda low, high: 3.0)
        assert campaign.interrupted(number, bad, SMALL, 1.0, late).hangs == 1
