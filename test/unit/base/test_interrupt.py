# SPDX-License-Identifier: Apache-2.0

"""Signals that come while another one's handler runs."""

import signal
import subprocess
import sys

from tactile_cdma.base.interrupt import stop_event

PATIENCE_S = 60.0
"""Far more than a child takes on a busy machine; a stuck one stays for ever."""
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
    subprocess.run([sys.executable, "-c", NESTED], check=True, timeout=PATIENCE_S)


def test_the_time_that_was_given_stops_it() -> None:
    with stop_event(1e-3) as stop:
        while not stop.is_set():
            pass


def test_a_program_that_nohup_runs_is_not_ended_by_sighup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_event(None) as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.is_set()
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        with stop_event(None) as stop:
            signal.raise_signal(signal.SIGHUP)
            assert stop.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)
