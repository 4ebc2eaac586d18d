# SPDX-License-Identifier: Apache-2.0

"""From the converter's counts to words: the real decoder reads the C core's packets."""

import ctypes

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.digitizer import quiet_uv
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.sim.channel import point_samples
from tactile_cdma.wire.messages import GetInfo, Start
from test.support.core_digitizer import Board, CoreDigitizer
from test.support.simulated import configuration


def line_counts(
    config: SkinConfig, frames: list[NDArray[np.int64]], first_us: float, rate_hz: float
) -> NDArray[np.uint16]:
    """Counts of a 12-bit converter for frames in which all nodes transmit, and half a period."""
    spec = config.spec
    size = int((first_us * 1e-6 + (len(frames) + 0.5) * spec.frame_period_s) * rate_hz)
    volts = np.zeros(size)
    for number, codes in enumerate(frames):
        start_s = first_us * 1e-6 + number * spec.frame_period_s
        levels = frame_levels(line_chips(spec, codes), spec)
        edges_s = start_s + np.arange(len(levels) + 1) * spec.chip_s
        volts += point_samples(levels, edges_s, rate_hz, 0, size)
    noise = np.random.default_rng(5).normal(0, 0.005, size)
    return np.clip(np.rint((volts + noise) * 250 + 2048), 0, 4095).astype(np.uint16)


SKINS = {
    "usual": {},
    "integrated": {"samples_per_chip": 1},
    "integrated, awkward": {"samples_per_chip": 1, "chip_us": 48.611},
    "awkward": {"samples_per_chip": 5, "chip_us": 48.611, "frame_period_ms": 12.347},
    "parity": {"parity": True, "samples_per_chip": 3},
    "resync": {"resync_chips": 32, "guard_chips": 4, "frame_period_ms": 20.0},
    "resync, integrated": {
        "resync_chips": 30,
        "guard_chips": 3,
        "frame_period_ms": 20.0,
        "samples_per_chip": 1,
    },
    "64 nodes": {"nodes": 64, "chip_us": 10.0, "samples_per_chip": 2, "rows": 8, "columns": 8},
}


@pytest.mark.parametrize("name", SKINS)
def test_the_host_reads_every_word(core: ctypes.CDLL, name: str) -> None:
    config = SkinConfig.of(SKINS[name])
    digitizer = CoreDigitizer(core, Board.of(volts_per_count=1 / 250), output=1 << 22)
    digitizer.send(configuration(config, quiet_uv(config.spec)), GetInfo(), Start())
    rng = np.random.default_rng(8)
    codes = [rng.integers(0, 1 << config.spec.bits, config.spec.nodes) for _ in range(25)]
    (pulse,) = digitizer.pulses(1)
    rate_hz = 48e6 / digitizer.ticks_per_sample
    digitizer.samples(line_counts(config, codes, pulse.announces / 48, rate_hz))
    data = digitizer.take()
    pipeline = Pipeline(config)
    frames = pipeline.feed(data, 1.0) + pipeline.flush()
    assert pipeline.problem is None
    assert len(frames) == len(codes)
    for frame, sent in zip(frames, codes, strict=True):
        assert frame.words.active.all()
        assert np.array_equal(frame.words.codes, sent)
    period_s = config.spec.frame_period_s
    assert np.allclose(np.diff([frame.t_start for frame in frames]), period_s, atol=5e-6)
