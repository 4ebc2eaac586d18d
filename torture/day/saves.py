# SPDX-License-Identifier: Apache-2.0

"""Kills programs in the middle of saving tares, of skins that take turns: no tare may be lost."""

from __future__ import annotations

import logging
import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tactile_cdma.base.errors import RestError
from tactile_cdma.rest.rest_file import RestState, RestStore, read_rest

from ..outcome import Outcome, Plan

KILLS, QUICK_KILLS = 1000, 30
MOST_SAVES = 4
"""Saves after which a program is killed in its next one. Chosen: all skins have had their turn."""
SKINS = "left", "right", "spare"
NODES = 64
_NAME = "skin.rest.yaml"


@dataclass
class Found:
    """What is wrong after a kill: files that cannot be read, tares that are nowhere, litter."""

    broken: int = 0
    lost: int = 0
    litter: int = 0


def run(plan: Plan) -> Outcome:
    """Kill so many programs."""
    rng = np.random.default_rng([plan.seed, 2])
    kills = QUICK_KILLS if plan.quick else KILLS
    found, saves = Found(), 0
    for _ in range(kills):
        with TemporaryDirectory() as folder:
            path = Path(folder) / _NAME
            saved = _killed(path, int(rng.integers(1, MOST_SAVES + 1)), rng.random())
            saves += saved
            judge(path, saved, found)
    return Outcome(
        "killed while it saves tares of skins that take turns",
        times=kills,
        wrong_values=found.broken,
        uncounted_losses=found.lost,
        crashes=found.litter,
        said=f"{saves:,} saves",
    )


def judge(path: Path, saved: int, found: Found) -> None:
    """Add what is wrong in a folder where so many saves were reported as done.

    One more may have been done, too. Then the next program saves.
    """
    tares = set[str]()
    for file in path.parent.glob(f"{_NAME}*"):
        try:
            state = read_rest(file)
            tares.add(state.tared if state else "")
        except RestError:
            found.broken += 1
    found.lost += len({str(number) for number in range(saved)} - tares)
    found.lost += saved > 0 and not path.exists()
    _save(path, saved + 1)
    found.litter += len(list(path.parent.glob(".*")))


def _killed(path: Path, after: int, share: float) -> int:
    """Kill a program within the save that follows so many; returns how many it had reported.

    share: of the time that the last save took, and a bit, before the kill.
    """
    reports, child_end = os.pipe()
    child = os.fork()
    if not child:
        with suppress(BaseException):
            for number in count():
                _save(path, number)
                os.write(child_end, b".")
        os._exit(1)
    os.close(child_end)
    with os.fdopen(reports, "rb", buffering=0) as file:
        for _ in range(after):
            began_s = time.monotonic()
            file.read(1)
        time.sleep(1.2 * share * (time.monotonic() - began_s))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return after + len(file.read())


def _save(path: Path, number: int) -> None:
    """Start as a driver does, with the next skin, and save its tare, which has this number."""
    store = RestStore(path, logging.Logger("silent", logging.CRITICAL))
    skin, zero_v = SKINS[number % len(SKINS)], np.full(NODES, 3.0, np.float32)
    present = RestState(skin, False, "", NODES, "", "")
    store.read(present)
    store.write(replace(present, tared=str(number), rest_v=zero_v, drift_v=zero_v))
