# SPDX-License-Identifier: Apache-2.0

"""A Skin in its process: what is logged, where processes fork, where the collector ends it."""

import gc
import logging
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from tactile_cdma import Decoder, Skin, read_recording
from tactile_cdma.base.whole_file import replace_file
from tactile_cdma.commands.cli import main
from tactile_cdma.config.parameters import read_file
from tactile_cdma.sim.options import SimOptions
from test.support import simulated
from test.support.programs import run_python
from test.support.waiting import PATIENCE_S, wait_for


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.DEBUG, "tactile_cdma")
    return caplog


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two seconds of the skin's time, however busy the machine is."""
    return simulated.recording(tmp_path / "touch.skin", SimOptions(scene="moving"), 2.0)


def test_files_read_or_written_are_logged(tmp_path: Path, log: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "skin.yaml"
    replace_file(path, "/left/skin:\n  ros__parameters: {nodes: 20}\n")
    read_file(path)
    assert log.messages == [
        f"wrote {path}",
        f"reading {path}",
        f"{path} has parameters for /left/skin",
    ]
    assert {record.name.rpartition(".")[0] for record in log.records} == {
        "tactile_cdma.base",
        "tactile_cdma.config",
    }


def test_frames_are_not_logged_but_losses_are(
    recording: Path, log: pytest.LogCaptureFixture
) -> None:
    decoder, frames, logged = Decoder(nodes=16), [0], [0]
    for data, t_host in read_recording(recording):
        frames.append(frames[-1] + len(decoder.feed(data, t_host)))
        logged.append(len(log.records))
    assert frames[-1] > 100
    begun = next(i for i, count in enumerate(frames) if count >= 10)
    assert logged[-1] == logged[begun], log.messages[logged[begun] :]
    recording.write_bytes(recording.read_bytes()[:-100])
    assert sum(len(data) for data, _ in read_recording(recording))
    assert any(message.startswith(f"{recording}: ") for message in log.messages)


def test_a_digitizer_and_a_loop_are_logged(recording: Path, log: pytest.LogCaptureFixture) -> None:
    assert main(["ports", "sim://"]) == 0
    assert log.messages[0].startswith("sim:// is open")
    assert any(message.startswith("sim://: 73696D0000000000, sim") for message in log.messages)
    with Skin(f"replay://{recording}?speed=0&loop=true", timeout_s=None) as skin:
        while f"{recording} begins again" not in log.messages:
            skin.read()


@pytest.mark.parametrize("verbose", [True, False])
def test_the_command_logs_on_stderr_if_asked_to(recording: Path, verbose: bool) -> None:
    words = ["-v"] * verbose + ["info", str(recording)]
    done = run_python("-m", "tactile_cdma", *words, check=True)
    assert (f"tactile_cdma.base.named_file: reading {recording}\n" in done.stderr) == verbose
    assert "checksum: right" in done.stdout


def test_nodes_that_a_tare_leaves_out_are_logged(log: pytest.LogCaptureFixture) -> None:
    port = "sim://?scene=idle&heartbeat=2&dead=3&speed=4"
    with Skin(port, nodes=16, stale_after_s=1.0) as skin:
        skin.tare(wait_s=PATIENCE_S)
    assert f"{port}: tared without node 3: no valid, certain reading" in log.messages


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


def test_any_thread_that_collects_a_skin_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
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
