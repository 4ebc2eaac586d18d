# SPDX-License-Identifier: Apache-2.0

"""What the kernel does in framing is what numpy does, but for rounding."""

from __future__ import annotations

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing import burst as bursts
from tactile_cdma.framing import judge
from tactile_cdma.framing.fit import Fit, Line, numpy_refine, refine
from tactile_cdma.framing.judge import Votes, Weighed
from test.support.synthetic_line import DEFAULT, SPECS, Wire

pytestmark = pytest.mark.skipif(kernel.compiled is None, reason="the kernel was not built")

KINDS = [*SPECS.values(), replace(DEFAULT, scramble=True), FrameSpec(nodes=40, chip_s=2e-5)]
LINES = st.fixed_dictionaries(
    {
        "spec": st.sampled_from(KINDS),
        "rate": st.sampled_from([3.3, 4.0, 8.13]),
        "nodes": st.sampled_from([0, 1, 2, 9, 16]),
        "rho": st.sampled_from([2.5, 6.0, 60.0, 1e4]),
        "stretch": st.floats(0, 0.1),
        "seed": st.integers(0, 1000),
    }
)


def line_of(line: dict) -> tuple[Wire, np.ndarray]:
    """One frame on a line, of none or more nodes, and a piece of the next one."""
    wire = Wire(line["spec"], line["rate"], line["seed"])
    wire.send_random(2, max(1, line["nodes"]))
    for sent in wire.sent:
        sent.chip = wire.chip * (1 + line["stretch"])
        sent.words = sent.words if line["nodes"] else {}
    volts = wire.volts(1.9 * wire.period, line["rho"], offset_v=0.1)
    return wire, volts.astype(np.float64)


@settings(max_examples=150, deadline=None)
@given(LINES, st.floats(-0.4, 0.4), st.floats(-2e-3, 2e-3), st.booleans())
def test_refined_timing(line: dict, off: float, longer: float, bounded: bool) -> None:
    wire, volts = line_of(line)
    start, chip = wire.sent[0].start + off * wire.chip, wire.sent[0].chip * (1 + longer)
    bounds = (start - 0.3, start + 0.3) if bounded else (-np.inf, np.inf)
    given = Line(volts, 0.1), Fit(start, chip), wire.spec, *bounds
    found, expected = refine(*given), numpy_refine(*given)
    assert found.start == pytest.approx(expected.start, abs=1e-3)
    assert found.chip == pytest.approx(expected.chip, abs=1e-5)


def same(found: Weighed, expected: Weighed) -> None:
    assert found.chips == expected.chips
    for name in ("rows", "amplitude", "uneven", "pedestal", "power", "spread", "misfit"):
        one, other = getattr(found.words, name), getattr(expected.words, name)
        assert one == pytest.approx(other, rel=1e-4, abs=2e-6), name
    assert astuple(found.votes) == pytest.approx(astuple(expected.votes), rel=1e-4)
    assert found.cost == pytest.approx(expected.cost, rel=1e-3, abs=1e-2)


@settings(max_examples=150, deadline=None)
@given(
    LINES,
    st.integers(-5, 0),
    st.integers(0, 5),
    st.sampled_from([None, Votes(0.05, 1e-3)]),
)
def test_candidates_whole_chips_apart(
    line: dict, earliest: int, latest: int, votes: Votes | None
) -> None:
    wire, volts = line_of(line)
    shifts = np.arange(earliest, latest + 1)
    start = wire.sent[0].start + shifts * wire.sent[0].chip
    chip = np.full(shifts.size, wire.sent[0].chip)
    view = float(start.min()), float((start + wire.spec.span_chips * chip).max())
    given = Line(volts, 0.1), start, chip, view, wire.spec, 1e-4, votes
    same(judge.weigh(*given), judge.numpy_weigh(*given))


@settings(max_examples=100, deadline=None)
@given(LINES, st.lists(st.tuples(st.floats(-2, 2), st.floats(-0.02, 0.1)), min_size=1, max_size=4))
def test_candidates_of_other_chips(line: dict, others: list[tuple[float, float]]) -> None:
    wire, volts = line_of(line)
    off, longer = np.array(others).T
    start, chip = wire.sent[0].start + off * wire.chip, wire.chip * (1 + longer)
    view = float(start.min()), float((start + wire.spec.span_chips * chip).max())
    given = Line(volts, 0.1), start, chip, view, wire.spec, 1e-4
    same(judge.weigh(*given), judge.numpy_weigh(*given))


@settings(max_examples=300, deadline=None)
@given(LINES, st.floats(0, 1), st.floats(0, 1), st.sampled_from([1e-12, 1e-5, 1e-2]))
def test_bursts_and_the_gaps_beside_them(
    line: dict, begin: float, end: float, variance: float
) -> None:
    wire, volts = line_of(line)
    volts = volts[int(begin * wire.period) : volts.size - int(end * wire.period)]
    search = bursts.BurstSearch(wire.spec, wire.rate_hz)
    known = bursts.Gap(0.11, variance, 0)
    gap, expected_gap = (
        find(search, volts, known) for find in (bursts.compiled_find_gap, bursts.numpy_find_gap)
    )
    assert (gap is None) == (expected_gap is None)
    if gap and expected_gap:
        assert astuple(gap) == pytest.approx(astuple(expected_gap), rel=1e-9, abs=1e-15)
    volts = volts - 0.1
    burst = bursts.compiled_find_burst(search, volts, variance)
    expected = bursts.numpy_find_burst(search, volts, variance)
    assert (burst is None) == (expected is None)
    if burst and expected:
        assert astuple(burst) == pytest.approx(astuple(expected), rel=1e-9)
        sides = int(max(burst.first, 0)), math.ceil(burst.last), burst
        beside = bursts.compiled_look_beside(search, volts, *sides)
        wanted = bursts.numpy_look_beside(search, volts, *sides)
        assert beside.level == pytest.approx(wanted.level, rel=1e-4, abs=1e-7)
        assert beside.variance == pytest.approx(wanted.variance, rel=1e-2, abs=1e-15)
        assert beside.quiet == wanted.quiet
