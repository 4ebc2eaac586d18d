# SPDX-License-Identifier: Apache-2.0

"""Waiting for what happens in another thread or process, on a machine of any speed."""

import time
from collections.abc import Callable

PATIENCE_S = 120.0
"""Far more than anything takes on a busy machine: only what never happens runs into it."""


def wait_for(condition: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
    """Wait until the condition holds; one about the last of no messages does not."""
    deadline = time.monotonic() + timeout_s
    while not holds(condition):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def holds(condition: Callable[[], object]) -> bool:
    try:
        return bool(condition())
    except IndexError:
        return False
