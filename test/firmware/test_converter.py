# SPDX-License-Identifier: Apache-2.0

"""What the RP2040's converter, whose codes 512, 1536, 2560 and 3584 are wide, leaves of a bit."""

from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.code.encode import line_chips
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig

CONFIG = Path(__file__).resolve().parents[2] / "config"
WIDE_COUNTS = 8.9
"""Width of these codes; of others a little less than 1 (RP2040-E11; pico-adc.markomo.me)."""


def converted(counts: np.ndarray) -> np.ndarray:
    """Codes for voltages in ideal counts."""
    widths = np.full(4096, (4096 - 4 * WIDE_COUNTS) / 4092)
    widths[[512, 1536, 2560, 3584]] = WIDE_COUNTS
    return np.clip(np.searchsorted(np.cumsum(widths), counts, side="right"), 0, 4095)


@pytest.mark.parametrize("skin", ["breadboard", "wired_skin", "wired_64", "thousand_skin"])
def test_the_weakest_bit_keeps_its_level(skin: str) -> None:
    spec = SkinConfig.of(read_file(CONFIG / f"{skin}.yaml")).spec
    assert spec.amplitude_v is not None
    rng, amplitude = np.random.default_rng(1), spec.amplitude_v / 3.3 * 4096
    for _ in range(5):
        codes = rng.integers(0, 1024, spec.nodes)
        line = line_chips(spec, codes, np.ones(spec.nodes, bool), amplitude_v=1.0)
        read = converted(2048 + amplitude * line + rng.standard_normal(line.shape)) / amplitude
        levels = (read - read.mean()) @ spec.node_rows.T.astype(np.float32) / spec.order
        assert np.abs(levels).min() > 0.94
