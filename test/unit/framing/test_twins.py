# SPDX-License-Identifier: Apache-2.0

"""What the kernel does in framing is what numpy does, but for rounding."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.frame import UNIPOLAR, FrameSpec
from tactile_cdma.code.separate import node_levels
from tactile_cdma.framing.fit import (
    Fit,
    Line,
    WordFit,
    fit_words,
    refine,
    word_floor,
)
from tactile_cdma.framing.gaps.burst import Gap
from tactile_cdma.framing.gaps.gap_timing import GapTiming
from tactile_cdma.framing.gaps.search import GapSearch
from tactile_cdma.framing.raster import Expected
from tactile_cdma.framing.timing import share_clipped
from test.support.correlations import lines
from test.support.examples import examples
from test.support.synthetic_line import DEFAULT, SPECS, Wire, check, run, words_of

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


@examples(150)
@given(LINES, st.floats(-0.3, 0.3), st.floats(-2e-4, 2e-4), st.booleans())
def test_refined_timing(line: dict, off: float, longer: float, bounded: bool) -> None:
    """Of a loud frame its edges, and nothing beyond the bounds."""
    wire, volts = line_of({**line, "rho": 1e4, "nodes": 9})
    sent = wire.sent[0]
    bounds = (sent.start + 0.1, sent.start + 0.2) if bounded else (-np.inf, np.inf)
    begun = Fit(sent.start + off * wire.chip, sent.chip * (1 + longer))
    found = refine(Line(volts, 0.1), begun, wire.spec, *bounds)
    if bounded:
        assert bounds[0] <= found.start <= bounds[1]
    else:
        # A sample tells its side of an edge only; of chips of whole samples all tell the same.
        end = sent.start + wire.spec.span_chips * sent.chip
        assert found.start == pytest.approx(sent.start, abs=0.55)
        assert found.end(wire.spec) == pytest.approx(end, abs=0.55)


@examples(150)
@given(
    LINES, st.floats(0, 1), st.floats(0, 1), st.sampled_from([1e-12, 1e-5, 1e-2]), st.floats(-1, 1)
)
def test_what_the_kernel_sees_at_once(
    line: dict, begin: float, end: float, variance: float, off: float
) -> None:
    """Gap, burst, frame and the gaps beside it, each as numpy sees it."""
    wire, volts = line_of(line)
    cut = int(begin * wire.sent[0].start)
    volts = volts[cut : volts.size - int(end * wire.period)]
    rails_v = -1e9, float(np.quantile(volts, 0.9))
    search = GapSearch(wire.spec, wire.rate_hz, rails_v)
    known, chip = Gap(0.11, variance, 0), wire.sent[0].chip
    expected = Expected(wire.sent[0].start - cut + 0.1 * off * chip, 0.06 * chip, chip, 0.0, 0.02)
    look = search.look(volts, volts, known, 0.0, expected)
    gaps = search.gaps(volts, known)
    assert (look is None) == (not gaps)
    if look is None:
        return
    # Where there is no noise, the variance is what rounding leaves of all squares, times _CALMER.
    rounding = 1e3 * np.finfo(float).eps * float(np.square(volts).sum())
    assert astuple(look.gap) == pytest.approx(astuple(gaps[0]), rel=1e-9, abs=rounding)
    numpy_line = Line(volts, look.gap.level)
    burst = search.burst(numpy_line.volts, look.gap.variance)
    assert look.is_silent == (burst is None)
    if burst is None or look.burst is None:
        return
    assert astuple(look.burst) == pytest.approx(astuple(burst), rel=1e-9)
    fit = search.carried(numpy_line, expected)
    if fit is not None and look.proven:
        assert look.proven == pytest.approx(search.proven(burst, fit), abs=1.01 * chip)
    if look.found is None:
        return
    assert fit is not None and look.beside is not None
    found = search.explained(numpy_line, burst, fit, expected)
    assert found is not None and found.decided and found.doubtful is None
    assert found.unaided == look.found.unaided
    assert astuple(look.found.fit) == pytest.approx(astuple(fit), rel=1e-6)
    assert look.found.words.rows == pytest.approx(found.words.rows, rel=1e-4, abs=2e-6)
    assert look.found.words.misfit == pytest.approx(found.words.misfit, rel=1e-3, abs=1e-5)
    beside = search.beside(numpy_line.volts, look.found.fit, burst)
    assert look.beside.level == pytest.approx(beside.level, rel=1e-4, abs=1e-6)
    assert look.beside.variance == pytest.approx(beside.variance, rel=1e-2, abs=1e-15)
    assert look.beside.quiet == beside.quiet
    frame = volts[max(0, round(fit.start)) : round(fit.end(wire.spec))]
    assert look.clipped == pytest.approx(share_clipped(frame, rails_v), abs=2 / frame.size)
    if look.is_sound:
        noise = beside.variance * search.half / fit.chip
        assert beside.quiet and found.words.believable(wire.spec, 1.02 * noise)
        levels = node_levels(found.words.rows[0], wire.spec)
        assert look.levels(wire.spec).values == pytest.approx(levels.values, rel=1e-4, abs=2e-6)
        assert look.levels(wire.spec).noise_v == pytest.approx(levels.noise_v, rel=1e-3, abs=1e-7)


def test_most_frames_of_a_sound_stream_are_seen_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same frames are found by those who look more closely, and rarely need be."""
    wire = Wire(DEFAULT, 4.0, seed=3)
    wire.send_random(80, nodes=12, wander=0.02)
    for sent in wire.sent:
        sent.chip = 1.02 * wire.chip
    volts, closely = wire.volts(rho=30), []
    for owner, name in ((GapSearch, "carried"), (GapSearch, "frame"), (WordFit, "believable")):
        original = getattr(owner, name)
        monkeypatch.setattr(
            owner, name, lambda *given, call=original: closely.append(1) or call(*given)
        )
    frames = run(GapTiming(DEFAULT, wire.rate_hz), volts)
    assert len(closely) < 150  # three for each of the first 32, and for some others
    monkeypatch.setattr(GapSearch, "look", lambda *_: None)
    others = run(GapTiming(DEFAULT, wire.rate_hz), volts)
    assert [words_of(f, DEFAULT) for f in frames] == [words_of(f, DEFAULT) for f in others]
    assert [f.start for f in frames] == pytest.approx([f.start for f in others], abs=0.01)
    check(wire, frames)


@examples(200)
@given(lines())
def test_words_of_candidates_are_those_of_the_formula(line: tuple[FrameSpec, np.ndarray]) -> None:
    """Mean |r| of nodes that speak; what it scatters by; and what all words leave of the rows."""
    spec, rows = line
    found, rms = fit_words(rows, spec), float(np.sqrt(np.mean(np.square(rows))))
    wide = rows.astype(np.float64)
    own = wide[..., spec.node_slice]
    mean = np.abs(own).mean(axis=1)
    active = mean > word_floor(mean.astype(np.float32), spec)
    assert np.array_equal(found.amplitude > 0, active)
    amplitude, uneven = mean * active, (np.square(own).mean(axis=1) - np.square(mean)) * active
    pedestal, meant = np.zeros(len(rows)), wide
    if spec.drive == UNIPOLAR:
        pedestal = wide[..., 0].mean(axis=1)
    elif spec.first_row > 0:
        meant = wide[..., 1:]
    words = np.square(amplitude).sum(axis=1)
    power = words + np.square(pedestal)
    expected = {"amplitude": amplitude, "pedestal": pedestal, "uneven": uneven, "power": power}
    for name, values in expected.items():
        scale = rms if name in ("amplitude", "pedestal") else rms**2
        np.testing.assert_allclose(
            getattr(found, name), values, rtol=2e-5, atol=4e-6 * scale, err_msg=name
        )
    spoken = power > 1e-9
    total = np.square(meant).sum(axis=(1, 2))[spoken] / spec.line_bits
    np.testing.assert_allclose(
        found.misfit[spoken], total / power[spoken] - 1, rtol=1e-4, atol=1e-4
    )
    even = spoken & (words > 1e-9)
    np.testing.assert_allclose(
        found.spread[even], uneven.sum(axis=1)[even] / words[even], rtol=1e-4, atol=1e-4
    )


def test_levels_that_are_no_numbers_are_no_words() -> None:
    """Of a frame that holds samples that were not received."""
    spec = FrameSpec(nodes=16, amplitude_v=0.3)
    rows = np.full((1, spec.line_bits, spec.order), 0.3, np.float32)
    rows[0, 3, 5] = np.nan
    assert not (fit_words(rows, spec).amplitude > 0).any()
