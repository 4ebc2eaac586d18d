# SPDX-License-Identifier: Apache-2.0

"""Signals that come while another one's handler runs."""

from __future__ import annotations

import signal
import sys
from types import FrameType
from typing import Any

from tactile_cdma.base.interrupt import stop_event


def test_a_signal_within_the_handler_of_another_one_stops_as_well() -> None:
    raised: list[str] = []

    def again(frame: FrameType, event: str, _: Any) -> None:
        """SIGTERM at every call and return that SIGINT's handler makes."""
        if len(raised) < 20:
            raised.append(f"{event} {frame.f_code.co_name}")
            signal.raise_signal(signal.SIGTERM)

    with stop_event(None) as stop:
        assert not stop.is_set()
        sys.setprofile(again)
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            sys.setprofile(None)
        assert stop.is_set() and any("set" in at for at in raised)


def test_the_time_that_was_given_stops_it() -> None:
    with stop_event(1e-3) as stop:
        while not stop.is_set():
            pass
