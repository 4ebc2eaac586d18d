# SPDX-License-Identifier: Apache-2.0

"""Drivers where there is no room: full and read-only disks, no shared memory, many at once."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from std_srvs.srv import Trigger

from ..outcome import Outcome, Plan, Tally
from .loaded_skin import LOADED, LoadedSkin, frames_missing

PLACES = {
    "its files on a disk without space": (
        'mount -t tmpfs -o size=16k none "$0" && cat /dev/zero > "$0/full" 2> "$0/../said"; :'
    ),
    "its files on a read-only disk": 'mount -t tmpfs -o ro none "$0"',
    "no shared memory": "mount -t tmpfs -o ro none /dev/shm",
    "shared memory that is full": "mount -t tmpfs -o size=64k none /dev/shm",
}
"""What is mounted before the driver starts, for it alone; $0: its state folder."""
CROWDED = replace(LOADED, parameters={**LOADED.parameters, "frame_period_ms": 100.0})
"""Slow skins, as the judge hears all of them in one process."""


def without_room(plan: Plan, folder: Path, patience_s: float) -> Iterator[Outcome]:
    """A driver in each place: frames come, and a file that cannot be written is told."""
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        return  # only root may mount
    for number, (name, mount) in enumerate(PLACES.items()):
        home = folder / f"place{number}"
        (home / "state").mkdir(parents=True)
        prefix = ["unshare", "--mount", "sh", "-c", f'{mount} && exec "$@"', str(home / "state")]
        with LoadedSkin(home, plan.seed, patience_s, prefix=prefix) as skin:
            skin.streams_on()
            client = skin.node.create_client(Trigger, f"{skin.name}/save_calibration")
            skin.waits_for(client.service_is_ready)
            call = client.call_async(Trigger.Request())
            saved = skin.waits_for(call.done) and call.result().success
            skin.streams_on()
            yield skin.outcome(f"a driver, {name}", 1, wrong=saved != ("files" not in name))


def crowded(plan: Plan, folder: Path, patience_s: float) -> Outcome:
    """Many drivers at the same time: everyone's frames come, and are its own."""
    count, total = 2 if plan.quick else 8, Tally()
    with ExitStack() as stack:
        skins = []
        for number in range(count):
            home = folder / f"crowd{number}"
            home.mkdir()
            skin = LoadedSkin(home, plan.seed + number, patience_s, setting=CROWDED)
            skins.append(stack.enter_context(skin))
        for skin in skins:
            skin.streams_on(50)
        for skin in skins:
            total += skin.judge.tally
            total += Tally(crashes=skin.defects() + (skin.process.poll() is not None))
            total += Tally(hangs=skin.hangs)
    total.times = count
    return total.outcome("drivers at the same time, on one computer", frames_missing(total))
