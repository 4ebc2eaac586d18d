# SPDX-License-Identifier: Apache-2.0

"""Values over time: curves of the last seconds."""

import numpy as np

from tactile_cdma.views.history import History


def test_bins_keep_the_greatest_of_their_time_and_forget_what_is_old() -> None:
    history = History(span_s=4.0)
    for now_s, value in ((0.0, 99.0), (6.5, 1.0), (7.1, 5.0), (7.2, 2.0), (9.9, 3.0)):
        history.add(now_s, value)
    history.add(10.0, float("nan"))
    np.testing.assert_array_equal(history.bins(10.0, 4), [1.0, 5.0, np.nan, 3.0])
    np.testing.assert_array_equal(history.bins(12.0, 4), [np.nan, 3.0, np.nan, np.nan])


def test_a_history_of_nothing_is_unknown() -> None:
    history = History(span_s=1.0)
    assert np.isnan(history.bins(5.0, 3)).all()
    assert np.isnan(history.latest)
    history.add(4.0, 7.0)
    assert history.latest == 7.0
    history.add(5.5, float("nan"))
    assert np.isnan(history.latest), "not the last that was known"
    assert np.isnan(history.bins(5.5, 3)).all()
