# SPDX-License-Identifier: Apache-2.0

"""Public calls in any order raise what they say, and leave an object that works."""

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import run_state_machine_as_test

from tactile_cdma import Decoder
from test.support.call_orders import MACHINES

pytestmark = pytest.mark.xdist_group("public_skin")
EXAMPLES = {"Decoder": 25, "Skin": 20, "Body": 2, "LiveObservation": 20, "SkinBatch": 25}


@pytest.mark.parametrize("name", MACHINES)
def test_calls_in_any_order(name: str) -> None:
    run_state_machine_as_test(
        MACHINES[name],
        settings=settings(
            max_examples=EXAMPLES[name],
            stateful_step_count=15,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_a_flush_before_a_digitizer_has_described_itself() -> None:
    decoder = Decoder(nodes=16)
    assert decoder.flush() == []
    assert decoder.feed(b"noise", 0.0) == []
    assert decoder.flush() == [] == decoder.flush()
