# SPDX-License-Identifier: Apache-2.0

"""The emulated skin in real time."""

from itertools import count
from pathlib import Path

import pytest

from emulated import EmulatedSkin
from serve import SLOW, STEP_S, LiveSkin, nodes_for
from skin import PressedSkin, reference_amplifier
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.scene import SCENES
from trial import press_and_decode

CONFIG = Path(__file__).resolve().parents[2] / "config"


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
@pytest.mark.parametrize("file", ["wired_skin.yaml", "wired_64.yaml", "thousand_skin.yaml"])
def test_first_node_of_every_skin_that_can_be_built_is_heard(
    file: str, first: int, node_images: None
) -> None:
    """At its heartbeat, once a second: bring-up can be rehearsed with this parameter file."""
    config = SkinConfig.of(read_file(CONFIG / file))
    with EmulatedSkin(nodes_for(config)[:first], reference_amplifier(config)) as skin:
        pressed = PressedSkin(config, SCENES["idle"], skin, skin)
        frames = round(2.2 / config.spec.frame_period_s)
        trial = press_and_decode(pressed, config, frames)
    assert trial.frames >= frames
    heard = trial.frames * config.spec.nodes - trial.silent
    assert 2 * first <= heard <= 3 * first
