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

"""The emulated skin in the host's time."""

from __future__ import annotations

from itertools import count

import pytest

from serve import SLOW, STEP_S, LiveSkin


class Skin:
    """Something that takes emulated time."""

    now_ns = 0

    def run(self, t_ns: int) -> None:
        self.now_ns = t_ns

    def read(self) -> bytes:
        return b""


@pytest.mark.parametrize(("slowness", "said"), [(0.9, ""), (3.0, SLOW + "\n")])
def test_an_emulation_that_falls_behind_says_so_once(
    capsys: pytest.CaptureFixture[str], slowness: float, said: str
) -> None:
    seconds = count()
    live = LiveSkin(Skin(), lambda: next(seconds) * slowness * STEP_S)  # type: ignore[arg-type]
    for _ in range(1000):
        live.advance(1)
    assert capsys.readouterr().err == said
