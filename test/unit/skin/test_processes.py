# SPDX-License-Identifier: Apache-2.0

"""A Skin where processes fork, and where the garbage collector ends it."""

import gc
import sys
import threading
from typing import Any

import pytest

from tactile_cdma import Skin
from test.support.programs import run_python
from test.support.waiting import wait_for

FORKS = """
import os, sys, threading, time
from tactile_cdma import PortError, Skin

inside, go_on = threading.Event(), threading.Event()

def listen():
    inside.set()
    go_on.wait()

skin = Skin("sim://", nodes=16, timeout_s=100.0).open()
skin.read()
with skin.telling(listen):
    inside.wait()  # the driver's thread has the lock of the frames, and no child ever frees it
    child = os.fork()
    if child == 0:
        look = lambda: skin.problem
        for ask in (skin.read, skin.newest, skin.latest, skin.waiting, skin.tare, look):
            try:
                ask()
                print("no error")
            except PortError as error:
                print(error, flush=True)
        if "close" in sys.argv:
            skin.close()
        sys.exit(0)
    go_on.set()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
print("child", code, flush=True)
last = skin.newest().sequence
print("parent", skin.newest().sequence > last, flush=True)
skin.close()
"""


@pytest.mark.parametrize("how", ["close", "exit"])
def test_a_forked_child_is_told_so_and_ends_and_the_parent_goes_on(how: str) -> None:
    run = run_python("-c", FORKS, how, timeout=60)
    said = "sim://: a Skin does not survive a fork: close it, and open one in this process"
    assert run.stdout.splitlines() == [said] * 6 + ["child 0", "parent True"], run.stderr
    assert run.stderr == ""


def test_a_skin_in_a_cycle_is_ended_by_whichever_thread_collects_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its own driver's, too, which cannot wait for its own end."""
    failed: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", failed.append)
    gc.disable()
    try:
        skin = Skin("sim://", nodes=16).open()
        inbox, thread = skin._inbox, skin._driver._thread  # type: ignore[union-attr]
        skin.itself = skin  # type: ignore[attr-defined]
        collect = threading.Event()
        inbox.listeners.add(lambda: gc.collect() if collect.is_set() else None)
        skin.read()
        del skin
        collect.set()
        wait_for(lambda: not thread.is_alive())
    finally:
        gc.enable()
    assert not failed and inbox.closed
    assert not inbox.frames, "frames that nobody will take"
