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
        ("sim", "libsimavr-dev"),
    ],
)
def test_target_without_its_tools_skips(
    built: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    target: str,
    missing: str,
) -> None:
    if missing == "libsimavr-dev":
        monkeypatch.setattr("test.support.firmware.SIMAVR", tmp_path / "sim_avr.h")
    else:
        monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(pytest.skip.Exception, match=f"no {missing} on this machine"):
        built(target)
