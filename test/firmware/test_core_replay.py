# SPDX-License-Identifier: Apache-2.0

"""The core built for other machines: identical bytes, and its cost in instructions."""

import ctypes
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire._protocol import SyncMode
from tactile_cdma.wire.messages import Configure, FrameLayout, GetInfo, Groups, Pack, Start, Stop
from tactile_cdma.wire.packets import wrap
from test.support.core_digitizer import Board, CoreDigitizer
from test.support.firmware import need, run

LAYOUT = FrameLayout.of(FrameSpec(), 4)
INSTRUCTIONS_PER_SAMPLE = 60
"""Of a Cortex-M0+, at most: 5 % of an RP2040's core at 80,000 samples per second."""


def script(digitizer: CoreDigitizer) -> bytes:
    """Calls to a digitizer, for digitizer/replay."""
    start = struct.pack("<QII", 0, digitizer.output_size, digitizer.capacity)
    return (
        start
        + bytes(digitizer.board)[: Board.max_count.offset + Board.max_count.size]  # no pointers
        + b"".join(
            kind.encode() + struct.pack("<I", len(data)) + data for kind, data in digitizer.events
        )
    )


def busy_day(core: ctypes.CDLL) -> CoreDigitizer:
    """A digitizer on which every function has been called."""
    digitizer, rng = CoreDigitizer(core, capacity=1000, output=40_000), np.random.default_rng(1)
    digitizer.time(0)
    layouts = [
        LAYOUT,
        replace(LAYOUT, chip_ns=48_611, frame_period_us=12_347, parity=True),
        replace(LAYOUT, resync_chips=30, guard_chips=3, frame_period_us=13_001),
        replace(LAYOUT, order=300, chip_ns=20_001, frame_period_us=61_000),
    ]
    setups = [
        Configure(layout, sync, integrated, quiet)
        for layout in layouts
        for integrated in (False, True)
        for sync in (SyncMode.NONE, SyncMode.DRIVE)
        for quiet in (0, 90_000)
    ]
    now_us = 0
    for asked in setups:
        now_us += int(rng.integers(1, 900_000))
        digitizer.time(now_us)
        digitizer.receive(rng.bytes(7) + b"\0" + wrap(rng.bytes(5)))
        digitizer.send(asked, GetInfo(), Start())
        for turn in range(9):
            digitizer.pulses(2)
            if turn == 3:
                digitizer.send(Pack(), Groups(turn % 4))
            if turn == 5:
                digitizer.lost(int(rng.integers(1, 900)))
            loud = rng.integers(0, 4096, 700)
            digitizer.samples(loud if turn % 4 == 0 else 2040 + loud % 5)
            digitizer.take(int(rng.integers(0, 4000)))
    digitizer.send(Stop())
    digitizer.take()
    return digitizer


def replayed(command: list[str | Path], digitizer: CoreDigitizer, tmp_path: Path) -> bytes:
    """Output of a replay whose command takes file names last."""
    (tmp_path / "events").write_bytes(script(digitizer))
    run(*command, cwd=tmp_path)
    return (tmp_path / "output").read_bytes()


def in_qemu(image: Path) -> list[str | Path]:
    machine = ["-M", "mps2-an385", "-icount", "shift=0", "-nographic", "-monitor", "none"]
    arguments = "enable=on,target=native,arg=replay,arg=events,arg=output"
    semihosting = ["-serial", "none", "-semihosting-config", arguments]
    return [need("qemu-system-arm"), *machine, *semihosting, "-kernel", image]


def test_the_core_is_the_same_on_every_machine(
    core: ctypes.CDLL, built: Callable[[str], Path], tmp_path: Path
) -> None:
    digitizer = busy_day(core)
    native = built("replay-native") / "replay" / "replay"
    assert replayed([native, "events", "output"], digitizer, tmp_path) == digitizer.given
    need("arm-none-eabi-gcc")
    image = built("replay-arm") / "replay" / "replay.elf"
    (tmp_path / "output").unlink()
    assert replayed(in_qemu(image), digitizer, tmp_path) == digitizer.given
    assert len(digitizer.given) > 100_000


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        ("raw", Configure(LAYOUT)),
        ("raw, quiet asked for", Configure(LAYOUT, quiet_uv=100_000)),
        ("integrated", Configure(LAYOUT, integrated=True)),
    ],
)
def test_a_sample_costs_few_instructions(
    core: ctypes.CDLL, built: Callable[[str], Path], tmp_path: Path, name: str, asked: Configure
) -> None:
    need("arm-none-eabi-gcc")
    command = in_qemu(built("replay-arm") / "replay" / "replay.elf")
    digitizer = CoreDigitizer(core, capacity=1000, output=20_000)
    digitizer.send(asked, Start())
    line = np.random.default_rng(2).integers(0, 4096, 128)
    for _ in range(400):
        digitizer.samples(line)
        digitizer.take()
    (tmp_path / "events").write_bytes(script(digitizer))
    printed = run(*command, cwd=tmp_path)
    samples, instructions = map(int, re.findall(r"\d+", printed))
    print(f"{name}: {instructions / samples:.1f} instructions per sample")
    assert samples == 400 * 128
    assert 2 < instructions / samples < INSTRUCTIONS_PER_SAMPLE


def test_a_script_that_ends_early_is_refused(
    core: ctypes.CDLL, built: Callable[[str], Path], tmp_path: Path
) -> None:
    digitizer = CoreDigitizer(core)
    digitizer.samples(np.zeros(10))
    native = built("replay-native") / "replay" / "replay"
    for cut in (-1, 5):
        (tmp_path / "events").write_bytes(script(digitizer)[:cut])
        with pytest.raises(AssertionError, match=r"replay: .*(longer|no start)"):
            run(native, "events", "output", cwd=tmp_path)
