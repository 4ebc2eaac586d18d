# SPDX-License-Identifier: Apache-2.0

"""Whether two ways of decoding give the same, to the bit."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from tactile_cdma.driver.pipeline import TactileFrame


def assert_same(
    some: Sequence[TactileFrame], others: Sequence[TactileFrame], *, at_host: bool = True
) -> None:
    """at_host: their host times are the same, too."""
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        for name in ("sequence", "t_start", "t_middle", "chip_s", "clipped"):
            assert getattr(one, name) == getattr(other, name), name
        assert not at_host or one.t_host == other.t_host
        for part in ("words", "readings"):
            mine, theirs = getattr(one, part), getattr(other, part)
            for item in fields(mine):
                values = getattr(mine, item.name), getattr(theirs, item.name)
                np.testing.assert_array_equal(*values, err_msg=f"{part}.{item.name}")
