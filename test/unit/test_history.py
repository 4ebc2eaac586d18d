# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The last seconds of a value."""

from __future__ import annotations

import numpy as np

from tactile_cdma.history import History


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
    history.add(5.0, float("nan"))
    assert np.isnan(history.bins(5.0, 3)).all()
