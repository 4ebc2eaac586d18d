# SPDX-License-Identifier: Apache-2.0

"""A machine without the firmware's toolchains: tests are skipped and name what is missing."""

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("target", "missing"),
    [
        ("node", "avr-gcc"),
        ("rp2040", "arm-none-eabi-gcc"),
        ("replay-arm", "arm-none-eabi-gcc"),
        ("replay-native", "cc"),
        ("sim", "cc"),
    ],
)
def test_target_without_its_compiler_skips(
    built: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    target: str,
    missing: str,
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(pytest.skip.Exception, match=f"no {missing} on this machine"):
        built(target)


def test_emulation_without_simavr_skips(
    built: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("test.support.firmware.SIMAVR", tmp_path / "sim_avr.h")
    with pytest.raises(pytest.skip.Exception, match="no libsimavr-dev on this machine"):
        built("sim")
