# SPDX-License-Identifier: Apache-2.0

"""The last frames, as one view of one buffer."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.datasets.recent import RecentFrames


@given(st.integers(1, 8), st.integers(0, 30))
def test_the_window_is_always_the_last_frames_in_order(length: int, pushed: int) -> None:
    recent = RecentFrames(length, (2,))
    for i in range(pushed):
        recent.push(np.array([i + 1, -i], dtype=np.float32))
        window = recent.window
        assert window.flags.c_contiguous and window.base is not None
        assert np.shares_memory(window, recent._frames)
        expected = np.maximum(np.arange(i + 2 - length, i + 2), 0)
        assert window[:, 0].tolist() == expected.tolist()
    assert recent.count == pushed
