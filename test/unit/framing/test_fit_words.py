# SPDX-License-Identifier: Apache-2.0

"""The kernel fits words to candidates as numpy does."""

import numpy as np
import pytest
from hypothesis import given

from tactile_cdma.base import kernel
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.fit import compiled_fit_words, numpy_fit_words
from test.support.correlations import lines
from test.support.examples import examples

pytestmark = pytest.mark.skipif(kernel.compiled is None, reason=kernel.why_numpy)


@examples(200)
@given(lines())
def test_words_of_candidates_are_those_of_numpy(line: tuple[FrameSpec, np.ndarray]) -> None:
    spec, rows = line
    rms = float(np.sqrt(np.mean(np.square(rows))))
    found, expected = compiled_fit_words(rows, spec), numpy_fit_words(rows, spec)
    assert np.array_equal(found.amplitude > 0, expected.amplitude > 0)
    for name, scale in (("amplitude", rms), ("pedestal", rms), ("uneven", rms**2), ("power", rms)):
        a, b = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6 * scale, err_msg=name)
    spoken = expected.power > 1e-9
    for name in ("spread", "misfit"):
        a, b = getattr(found, name)[spoken], getattr(expected, name)[spoken]
        # numpy adds thousands of squares in float32, one after the other.
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4, err_msg=name)


def test_levels_that_are_no_numbers_are_no_words() -> None:
    """Of a frame that holds samples that were not received."""
    spec = FrameSpec(nodes=16, amplitude_v=0.3)
    rows = np.full((1, spec.line_bits, spec.order), 0.3, np.float32)
    rows[0, 3, 5] = np.nan
    found, expected = compiled_fit_words(rows, spec), numpy_fit_words(rows, spec)
    np.testing.assert_array_equal(found.amplitude, expected.amplitude)
