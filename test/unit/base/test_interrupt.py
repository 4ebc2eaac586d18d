# SPDX-License-Identifier: Apache-2.0

"""Signals that come while another one's handler runs."""

import signal

import pytest

from tactile_cdma.base.interrupt import SIGNALS, stop_event, terminable
from test.support.programs import run_python

NESTED = """
import signal, sys
from tactile_cdma.base.interrupt import stop_event

raised = []

def again(frame, event, _):
    "SIGTERM at every call and return that SIGINT's handler makes."
    if len(raised) < 20:
        raised.append(frame.f_code.co_name)
        signal.raise_signal(signal.SIGTERM)

with stop_event(None) as stop:
    assert not stop.is_set()
    sys.setprofile(again)
    signal.raise_signal(signal.SIGINT)
    sys.setprofile(None)
    assert stop.is_set() and "set" in raised, raised
"""


def test_a_signal_within_the_handler_of_another_one_stops_as_well() -> None:
    # In a process of its own: with a lock it would wait for ever, whatever signal it gets.
    run_python("-c", NESTED, check=True)


def test_the_time_that_was_given_stops_it() -> None:
    with stop_event(1e-3) as stop:
        while not stop.is_set():
            pass


@pytest.mark.parametrize("number", SIGNALS[1:])
def test_a_closed_terminal_and_sigterm_end_as_ctrl_c_does(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), terminable():
        signal.raise_signal(number)
    with stop_event(None) as stop:
        signal.raise_signal(number)
        assert stop.is_set()
    assert signal.getsignal(number) == before


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no SIGHUP")
def test_nohup_is_obeyed() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_event(None) as stop, terminable():
            signal.raise_signal(signal.SIGHUP)
            assert not stop.is_set()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
