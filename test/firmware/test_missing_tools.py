# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A machine without the firmware's toolchains: its tests are skipped, and say what is missing."""

from __future__ import annotations

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
    monkeypatch.setattr("conftest.SIMAVR", tmp_path / "sim_avr.h")
    with pytest.raises(pytest.skip.Exception, match="no libsimavr-dev on this machine"):
        built("sim")
