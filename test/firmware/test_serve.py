# SPDX-License-Identifier: Apache-2.0

"""The emulated skin in real time."""

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
