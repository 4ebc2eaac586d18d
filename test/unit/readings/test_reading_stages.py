# SPDX-License-Identifier: Apache-2.0

"""The kernel makes the same readings of words as numpy does, bit by bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.readings import stages
from tactile_cdma.readings.calibration import Curves, PressureCurve
from tactile_cdma.readings.stages import Status
from tactile_cdma.words import health
from tactile_cdma.words.decode import Words, silent

pytestmark = pytest.mark.skipif(kernel.compiled is None, reason=kernel.why_numpy)

BITS = 6
TABLE_V = np.linspace(0, 3.2, 1 << BITS, dtype=np.float32)
NODES = st.sampled_from([1, 2, 16, 33, 300])
SEEDS = st.integers(0, 2**32 - 1)


def words_of(nodes: int, rng: np.random.Generator) -> Words:
    """Whether they fit each other or not."""
    active, doubtful, doubled, odd, astray = rng.random((5, nodes)) < rng.random((5, 1))
    codes = rng.integers((1 << BITS) - 5, 1 << BITS, nodes).astype(np.int32) * active
    amplitude_v, rho, margin = rng.random((3, nodes), np.float32)
    hit = rng.random(nodes) < 0.05
    amplitude_v[hit] = np.nan
    return Words(
        active, codes, amplitude_v, rho * 20, margin, doubtful, doubled & doubtful, odd & doubtful,
        astray, 0.01,
    )  # fmt: skip


@given(NODES, SEEDS, st.floats(0.0, 5.0))
def test_words_are_taken_in_alike(nodes: int, seed: int, now_s: float) -> None:
    """Of nodes that were never heard, that went stale, that are masked or not trusted."""
    rng = np.random.default_rng(seed)
    words = words_of(nodes, rng)
    heard_s = np.where(rng.random(nodes) < 0.2, -np.inf, rng.uniform(0, 5, nodes))
    kept = [
        stages.Kept(
            rng.integers(0, 1 << BITS, nodes).astype(np.int32),
            rng.choice(np.array([0, Status.LOW_SNR], np.uint8), nodes),
            heard_s,
        )
    ]
    kept.append(stages.Kept(*(values.copy() for values in kept[0])))
    trust = stages.Trust(
        rng.choice(np.array([0, Status.WEAK, Status.FAULTY], np.uint8), nodes),
        rng.random(nodes) < 0.2,
        rng.uniform(3.0, 3.3, nodes).astype(np.float32),
    )
    ways = stages.compiled_hear, stages.numpy_hear
    found, expected = (
        way(words, some, TABLE_V, trust, now_s, 1.0) for way, some in zip(ways, kept, strict=True)
    )
    for values in (*zip(found, expected, strict=True), *zip(*kept, strict=True)):
        np.testing.assert_array_equal(*values)
    masked, saturated, uncalibrated = rng.random((3, nodes)) < 0.2
    both = []
    for way, heard in ((stages.compiled_finish, found), (stages.numpy_finish, expected)):
        reading_pa = np.arange(nodes, dtype=np.float32)
        way(heard, saturated, uncalibrated, masked, reading_pa)
        both.append((reading_pa, heard.voltage_v, heard.status))
    for a, b in zip(*both, strict=True):
        np.testing.assert_array_equal(a, b)


@given(NODES, SEEDS)
def test_voltages_are_converted_alike(nodes: int, seed: int) -> None:
    """By curves of two to four corners, from below their start to beyond their end."""
    rng = np.random.default_rng(seed)
    curves = []
    for _ in range(nodes):
        pressure_pa = np.cumsum(rng.uniform(1e3, 5e4, rng.integers(1, 4)))
        volts = 3.2 - np.cumsum(rng.uniform(0.1, 0.8, len(pressure_pa) + 1))
        curves.append(PressureCurve((0.0, *pressure_pa.tolist()), tuple(volts.tolist())))
    skin = Curves.of(curves)
    voltage_v, drift_v = rng.uniform([[-0.2], [-0.1]], [[3.5], [0.1]], (2, nodes)).astype(
        np.float32
    )
    arguments = voltage_v, drift_v, skin._pieces, skin._end_v
    found, expected = stages.compiled_convert(*arguments), stages.numpy_convert(*arguments)
    for values in zip(found, expected, strict=True):
        np.testing.assert_array_equal(*values)


@given(NODES, SEEDS, st.sampled_from([np.nan, 0.25]))
def test_words_are_counted_alike(nodes: int, seed: int, weak_v: float) -> None:
    rng = np.random.default_rng(seed)
    sums = np.tile(rng.random((5, nodes), np.float32), (2, 1, 1))
    suspected = np.tile(rng.integers(0, 3, nodes).astype(np.int32), (2, 1))
    for _ in range(3):
        words = words_of(nodes, rng)
        if rng.random() < 0.5:
            words = replace(words, astray=np.zeros(nodes, bool))
        found = [
            way(words, weak_v, sums[i], suspected[i])
            for i, way in enumerate((health.compiled_count, health.numpy_count))
        ]
        assert found[0] == found[1]
    np.testing.assert_array_equal(sums[0], sums[1])
    np.testing.assert_array_equal(suspected[0], suspected[1])


def test_a_code_that_no_converter_gives_is_refused() -> None:
    nothing = silent(1, 0.0)
    kept = stages.Kept(np.array([1 << BITS], np.int32), np.zeros(1, np.uint8), np.zeros(1))
    trust = stages.Trust(np.zeros(1, np.uint8), np.zeros(1, bool), np.zeros(1, np.float32))
    with pytest.raises(ValueError, match="code"):
        stages.compiled_hear(nothing, kept, TABLE_V, trust, 0.0, 1.0)
