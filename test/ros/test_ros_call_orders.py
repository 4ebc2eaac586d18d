# SPDX-License-Identifier: Apache-2.0

"""Public calls in any order, of the classes that need ROS, leave an object that works."""

from collections.abc import Iterator

import pytest

from test.support.call_orders import try_orders
from test.support.ros_call_orders import MACHINES, Heard


@pytest.fixture(autouse=True)
def only_here() -> Iterator[None]:
    yield
    Heard.end_impostor()


@pytest.mark.parametrize("name", MACHINES)
def test_calls_in_any_order(name: str) -> None:
    try_orders(MACHINES[name], 8)
