# SPDX-License-Identifier: Apache-2.0

"""Public calls in any order raise what they say, and leave an object that works."""

import pytest

from tactile_cdma import Decoder
from test.support.call_orders import MACHINES, try_orders

pytestmark = pytest.mark.xdist_group("public_skin")
EXAMPLES = {"Decoder": 25, "Skin": 20, "Body": 2, "LiveObservation": 20, "SkinBatch": 25}


@pytest.mark.parametrize("name", MACHINES)
def test_calls_in_any_order(name: str) -> None:
    try_orders(MACHINES[name], EXAMPLES[name])


def test_a_flush_before_a_digitizer_has_described_itself() -> None:
    decoder = Decoder(nodes=16)
    assert decoder.flush() == []
    assert decoder.feed(b"noise", 0.0) == []
    assert decoder.flush() == [] == decoder.flush()
