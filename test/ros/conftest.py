# SPDX-License-Identifier: Apache-2.0

"""Tests with ROS: each module has rclpy initialised."""

from collections.abc import Iterator

import pytest

from test.support.spinning import initialised


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    with initialised():
        yield
