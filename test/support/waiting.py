# SPDX-License-Identifier: Apache-2.0

"""Waiting for what happens in another thread or process, on a machine of any speed."""

import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""Far more than anything takes on a busy machine: only what never happens runs into it.

A test has 900 s (make test).
"""


def wait_for(condition: Callable[[], object]) -> None:
    """Wait until the condition holds; one about the last of no messages does not."""
    deadline = time.monotonic() + PATIENCE_S
    while not holds(condition):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def holds(condition: Callable[[], object]) -> bool:
    try:
        return bool(condition())
    except IndexError:
        return False
