# SPDX-License-Identifier: Apache-2.0

"""A skin of more nodes than chips, from the digitizer's bytes to words, against what was sent."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.arrays import Floats, Floats32
from tactile_cdma.commands.calibrate import read_recording
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.driver.vitals import Vitals
from tactile_cdma.framing.load import Load, capacity
from tactile_cdma.recording.offline import RawCapture
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import Disturbance, Waveform
from tactile_cdma.sim.nodes import NodeFrame
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
    config = SkinConfig.of(SKIN)
    return run(config, stream(config, url, frames)), sent(url)


def sent(url: str) -> Truth:
    digitizer = VirtualDigitizer(SimOptions.from_url(f"{url}&speed=0"), clock=lambda: 0.0)
    writer = PacketWriter()
    digitizer.receive(writer.encode(configuration(SkinConfig.of(SKIN))) + writer.encode(Start()))
    return Truth(digitizer)


@pytest.mark.parametrize("noise", ["0.005", "0.05"])
def test_what_is_certain_was_sent(noise: str) -> None:
    frames, truth = decoded(f"sim://?scene=moving&noise={noise}", 60)
    assert len(frames) >= 59
    certain = 0
    for frame in frames:
        words, true = frame.words, truth[frame.sequence]
        sure = ~words.doubtful
        assert np.array_equal(words.active[sure], true.active[sure])
        spoke = sure & true.active
        assert np.array_equal(words.codes[spoke], true.codes[spoke])
        certain += int(sure.all())
    assert certain > 50


def test_how_many_speak_is_told_and_that_it_is_too_many() -> None:
    config, vitals = SkinConfig.of(SKIN), Vitals()
    most = capacity(config.spec)
    for url, frames in (("sim://?scene=moving", 40), ("sim://?scene=all&threshold=0", 10)):
        pipeline = Pipeline(config)
        vitals.take(pipeline)
        decoded = pipeline.feed(stream(config, url, frames), 0.0)
        truth = sent(url)
        speakers = [int(truth[frame.sequence].active.sum()) for frame in decoded]
        load, window = pipeline.load, vitals.take(pipeline)
        assert load is not None
        found = [each for each in checkup.stream(pipeline, window, None) if each.key == "overload"]
        if max(speakers) <= most:
            assert load == Load(most, speakers[-1], max(speakers), 0)
            assert not found
        else:
            assert load.now == pytest.approx(speakers[-1], rel=0.2)
            assert load.overloads == window.rises.overloads == len(decoded)
            assert f"{len(decoded)} frames are flagged" in found[0].text
            assert f"the {most} that their codes tell apart" in found[0].text


def test_what_is_in_doubt_is_no_reading_to_calibrate_by(tmp_path: Path) -> None:
    capture = tmp_path / "touch.raw"
    capture.write_bytes(stream(SkinConfig.of(SKIN), "sim://?scene=all&threshold=0", 10))
    assert np.isnan(read_recording(capture, SkinConfig.of(SKIN)).voltage_v).all()


class NoiseEnds(Disturbance):
    """Noise of 1.14 amplitudes in the first 40 frames."""

    def added(self, frame: NodeFrame, edges_s: Floats) -> Iterator[Waveform]:
        return iter(())

    def disturbed(self, frame: NodeFrame, volts: Floats32, t_s: Floats) -> Floats32:
        noise_v = 0.342 * np.random.default_rng(frame.number).normal(size=volts.shape)
        return volts + np.float32(noise_v) if frame.number < 40 else volts


def test_a_node_that_speaks_as_noise_ends_is_not_claimed_to_be_silent() -> None:
    config, now_s = SkinConfig.of(SKIN | {"nodes": 100}), [0.0]
    options = SimOptions.from_url("sim://?scene=idle&heartbeat=100&noise=0.005")
    digitizer = VirtualDigitizer(options, lambda: now_s[0], NoiseEnds())
    digitizer.receive(Session(config).open())
    pipeline, truth = Pipeline(config), Truth(digitizer)
    for now_s[0] in np.arange(60) * config.spec.frame_period_s:
        digitizer.advance()
        for frame in pipeline.feed(digitizer.take(1 << 20), now_s[0]):
            sure, active = ~frame.words.doubtful, truth[frame.sequence].active
            assert np.array_equal(frame.words.active[sure], active[sure])
    assert sure.all() and pipeline.counters.frames > 55


def test_a_capture_that_begins_before_the_digitizer_was_set_is_decoded(tmp_path: Path) -> None:
    capture = tmp_path / "touch.raw"
    capture.write_bytes(stream(SkinConfig.of(SKIN), "sim://?scene=moving", 10))
    assert len(list(RawCapture(capture, {"amplitude_mv": 300.0}).frames())) >= 9


def test_info_tells_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "touch.skin"
    skin = "--codes sparse --nodes 120 --order 32 --samples-per-chip 1 --frame-period-ms 20"
    port = "sim://?scene=all&threshold=0"
    assert main(["record", port, str(path), "--seconds", "0.2", *skin.split()]) == 0
    capsys.readouterr()
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    said = re.search(r"at once: (\d+) at most, capacity 13, (\d+) fr", told)
    assert "50 µs chips, sparse codes" in told
    assert said and 100 < int(said[1]) < 140 and int(said[2]) > 2
