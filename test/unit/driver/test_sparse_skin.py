# SPDX-License-Identifier: Apache-2.0

"""A skin of more nodes than chips, from the digitizer's bytes to words, against what was sent."""

import numpy as np
import pytest

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Start
from tactile_cdma.wire.packets import PacketWriter
from test.support.simulated import Truth, configuration, run, stream

SKIN = {
    "codes": "sparse",
    "nodes": 400,
    "order": 96,
    "bits": 9,
    "parity": True,
    "chip_us": 5.0,
    "frame_period_ms": 8.0,
    "resync_chips": 96,
    "guard_chips": 20,
    "samples_per_chip": 1,
}


def decoded(url: str, frames: int) -> tuple[list[TactileFrame], Truth]:
    config, writer = SkinConfig.of(SKIN), PacketWriter()
    digitizer = VirtualDigitizer(SimOptions.from_url(f"{url}&speed=0"), clock=lambda: 0.0)
    digitizer.receive(writer.encode(configuration(config)) + writer.encode(Start()))
    return run(config, stream(config, url, frames)), Truth(digitizer)


@pytest.mark.parametrize("noise", ["0.005", "0.05"])
def test_what_is_certain_was_sent(noise: str) -> None:
    frames, truth = decoded(f"sim://?scene=moving&noise={noise}", 60)
    assert len(frames) >= 59
    certain = 0
    for frame in frames:
        words, sent = frame.words, truth[frame.sequence]
        sure = ~words.doubtful
        assert np.array_equal(words.active[sure], sent.active[sure])
        spoke = sure & sent.active
        assert np.array_equal(words.codes[spoke], sent.codes[spoke])
        certain += int(sure.all())
    assert certain > 50


def test_of_more_than_can_be_told_apart_nothing_is_certain() -> None:
    frames, _ = decoded("sim://?scene=all&threshold=0", 10)
    assert len(frames) >= 9
    for frame in frames:
        assert frame.words.doubtful.all()
