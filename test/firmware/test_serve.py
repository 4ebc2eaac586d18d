# SPDX-License-Identifier: Apache-2.0

"""The emulated skin in real time."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest

from emulated import EmulatedSkin
from serve import SLOW, STEP_S, LiveSkin, wired
from skin import PressedSkin, reference_amplifier, reference_nodes
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.scene import SCENES
from trial import press_and_decode


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


@pytest.mark.parametrize("first", [0, 1])
def test_nodes_that_are_not_wired_are_not_heard(
    first: int, emulator: None, built: Callable[[str], Path]
) -> None:
    built("node")
    config = SkinConfig.of({"nodes": 4, "rows": 2, "columns": 2, "amplitude_mv": 97.5})
    nodes = wired(reference_nodes(config, threshold=0), first)
    with EmulatedSkin(nodes, reference_amplifier(config)) as skin:
        trial = press_and_decode(PressedSkin(config, SCENES["moving"], skin, skin), config, 5)
    assert trial.frames >= 5
    assert trial.silent == trial.wrong == trial.frames * (4 - first)  # what is missing is wrong
