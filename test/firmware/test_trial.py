# SPDX-License-Identifier: Apache-2.0

"""`make firmware-test` must be able to fail (that it passes: test_data_wire_skin.py).

And the emulated skin in real time.
"""

from itertools import count

import pytest

from check import PARAMS, press
from emulated import EmulatedSkin
from serve import SLOW, STEP_S, LiveSkin, nodes_for
from skin import PressedSkin, reference_amplifier, reference_nodes
from tactile_cdma.base.errors import SpecError
from tactile_cdma.config.parameters import OWN, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.scene import SCENES
from trial import press_and_decode

pytestmark = pytest.mark.usefixtures("node_images")
CONFIG = SkinConfig.of(read_file(PARAMS) | {"sync_wire": OWN})  # edges are sharper there
FRAMES = 60


def test_nodes_by_clocks_of_their_own_are_counted_as_wrong() -> None:
    nodes = reference_nodes(CONFIG, threshold=0, discipline=False)
    with EmulatedSkin(nodes, reference_amplifier(CONFIG)) as skin:
        trial = press(skin, skin, CONFIG, FRAMES)
    assert trial.frames < FRAMES or trial.wrong > FRAMES


def test_a_sensor_that_says_something_else_is_counted_as_wrong() -> None:
    class Shorted(EmulatedSkin):
        def press(self, volts: object) -> None:
            super().press([0.0, *list(volts)[1:]])  # type: ignore[call-overload]

    with Shorted(reference_nodes(CONFIG, threshold=0), reference_amplifier(CONFIG)) as skin:
        trial = press(skin, skin, CONFIG, FRAMES)
    assert (trial.wrong, trial.silent) == (trial.frames, 0)


def test_amplitude_of_an_emulated_skin_must_be_known() -> None:
    with pytest.raises(SpecError, match="amplitude_mv is 0"):
        reference_nodes(SkinConfig.of({"nodes": 16, "amplitude_mv": 0.0}))


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
def test_first_node_of_every_skin_that_can_be_built_is_heard(file: str, first: int) -> None:
    """At its heartbeat, once a second: bring-up can be rehearsed with this parameter file."""
    config = SkinConfig.of(read_file(PARAMS.with_name(file)))
    with EmulatedSkin(nodes_for(config)[:first], reference_amplifier(config)) as skin:
        pressed = PressedSkin(config, SCENES["idle"], skin, skin)
        frames = round(2.2 / config.spec.frame_period_s)
        trial = press_and_decode(pressed, config, frames)
    assert trial.frames >= frames
    heard = trial.frames * config.spec.nodes - trial.silent
    assert 2 * first <= heard <= 3 * first
    assert trial.wrong >= trial.frames * (config.spec.nodes - first)  # as is what is missing
