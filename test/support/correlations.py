# SPDX-License-Identifier: Apache-2.0

"""Correlations and words of chips; those of frames that hypothesis draws, sound and disturbed."""

from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from tactile_cdma.code.frame import BIPOLAR, UNIPOLAR, FrameSpec
from tactile_cdma.code.separate import NodeLevels, node_levels
from tactile_cdma.code.transform import rows_of
from tactile_cdma.words.decode import Words, decode


def separate(chips: ArrayLike, spec: FrameSpec) -> NodeLevels:
    """The nodes' levels, from chips (k, N) V that are free of an offset if row 0 is assigned."""
    return node_levels(rows_of(np.asarray(chips, np.float32), spec), spec)


def read_chips(chips: ArrayLike, spec: FrameSpec, **how: Any) -> Words:
    """Their words; how: see decode."""
    return decode(separate(chips, spec), spec, **how)


SPECS = st.builds(
    lambda row_and_drive, **rest: FrameSpec(
        first_row=row_and_drive[0], drive=row_and_drive[1], **rest
    ),
    st.sampled_from([(0, BIPOLAR), (1, BIPOLAR), (2, BIPOLAR), (1, UNIPOLAR)]),
    nodes=st.sampled_from([1, 2, 3, 7, 16, 19, 128, 129, 300]),
    bits=st.sampled_from([8, 10, 16]),
    chip_s=st.just(1e-7),
    frame_period_s=st.just(1.0),
    polarity=st.sampled_from([1, -1]),
    sign_seed=st.sampled_from([None, 1]),
    amplitude_v=st.sampled_from([None, 0.3]),
    parity=st.booleans(),
)


@st.composite
def lines(draw: st.DrawFn, frames: int = 3) -> tuple[FrameSpec, np.ndarray]:
    """A skin and the correlations of some frames of it, (frames, k, N) float32, V."""
    spec = draw(SPECS)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = (frames, spec.line_bits, spec.order)
    of_nodes = [[0.3], [0.3, 0.0], [0.3, 0.29, 0.05], [0.0], [0.3, 0.7, 0.11, 0.0], [30.0]]
    amplitudes = draw(st.sampled_from(of_nodes))
    rows = np.zeros(shape)
    signs = rng.choice([-1.0, 1.0], (frames, spec.line_bits, spec.nodes))
    if spec.parity and draw(st.booleans()):
        signs[:, -1] = np.where((signs[:, :-1] > 0).sum(axis=1) % 2, 1, -1) * spec.signs
    rows[..., spec.node_slice] = signs * rng.choice(amplitudes, spec.nodes)
    hit = rng.random(shape) < draw(st.sampled_from([0.0, 0.0, 0.02]))
    rows[hit] *= rng.choice([-0.5, 0.0, 2.0], np.count_nonzero(hit))
    rows += rng.normal(0, draw(st.sampled_from([0.0, 1e-3, 0.03, 0.2])), shape)
    return spec, rows.astype(np.float32)
