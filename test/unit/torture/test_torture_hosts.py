# SPDX-License-Identifier: Apache-2.0

"""The network between simulated hosts does what it is told, and the judges find planted defects."""

import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from torture.hosts.judge import (
    BODY,
    BODY_CONTACTS,
    CONTACTS,
    Heard,
    arrivals,
    deaf_claims,
    false_claims,
    untold,
)
from torture.hosts.relay import Switch, Weather
from torture.hosts.rig import WrongClock

BROADCAST, MULTICAST = b"\xff" * 6, b"\x01\x00\x5e\x00\x00\x01"
MAC = {name: bytes([2, 0, 0, 0, 0, number]) for number, name in enumerate("abc")}


def switch(weather: Weather) -> Switch:
    """A switch that has heard of all its hosts, in this weather."""
    made = Switch(tuple(MAC), seed=1)
    for name, address in MAC.items():
        made.take(BROADCAST + address, name, 0.0)
    made.due(math.inf)
    made.weather = weather
    return made


def arrived(made: Switch, to: bytes, port: str = "a", now_s: float = 0.0) -> list[str]:
    """The hosts that a frame from this one reaches."""
    made.take(to + MAC[port] + b"content", port, now_s)
    return sorted(name for name, _ in made.due(math.inf))


def test_frames_go_to_whom_they_are_for() -> None:
    made = switch(Weather())
    assert arrived(made, MAC["b"]) == ["b"]
    assert arrived(made, MULTICAST) == arrived(made, BROADCAST) == ["b", "c"]
    assert arrived(Switch(tuple(MAC), 1), MAC["b"]) == ["b", "c"]  # nobody knows yet who is where


def test_frames_take_their_time() -> None:
    made = switch(Weather(delay_s=0.010, jitter_s=0.005))
    for _ in range(2000):
        made.take(MAC["b"] + MAC["a"], "a", 100.0)
    assert made.due(100.0049) == []
    early = len(made.due(100.0075))
    assert 400 < early < 600  # a quarter: equally distributed
    assert len(made.due(100.0151)) == 2000 - early
    assert made.pause_s(100.0) is None


def test_frames_are_lost_by_chance_and_counted() -> None:
    made = switch(Weather(loss=0.05))
    came = sum(len(arrived(made, MAC["b"])) for _ in range(4000))
    assert made.counts.lost == 4000 - came
    assert made.counts.lost == pytest.approx(200, abs=5 * math.sqrt(4000 * 0.05 * 0.95))


def test_a_host_that_is_cut_off_neither_sends_nor_receives() -> None:
    made = switch(Weather(cut=("a",)))
    assert arrived(made, MAC["b"], "a") == arrived(made, MAC["a"], "b") == []
    assert arrived(made, BROADCAST, "b") == ["c"]
    assert made.counts.stopped == 3


def test_a_network_may_drop_multicast_alone() -> None:
    made = switch(Weather(multicast=False))
    assert arrived(made, MULTICAST) == []
    assert (arrived(made, BROADCAST), arrived(made, MAC["c"])) == (["b", "c"], ["c"])


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler")
def test_a_wrong_clock_is_off_by_what_it_is_set_to(tmp_path: Path) -> None:
    clock = WrongClock(tmp_path, "x")
    program = (
        "from time import monotonic_ns, time_ns\n"
        "while input(): print(monotonic_ns(), time_ns(), monotonic_ns(), flush=True)"
    )
    reader = subprocess.Popen(
        [sys.executable, "-c", program],
        env={**os.environ, **clock.environment},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert reader.stdin and reader.stdout

    def ahead_s() -> float:
        while True:
            print("now", file=reader.stdin, flush=True)
            before_ns, wall_ns, after_ns = map(int, reader.stdout.readline().split())
            if after_ns - before_ns < 1_000_000:  # else the program was held up
                return (wall_ns - before_ns) * 1e-9

    right_s = ahead_s()
    for offset_s in (0.05, -3600.0, 0.0):
        clock.set(offset_s)
        assert ahead_s() - right_s == pytest.approx(offset_s, abs=2e-3)
    reader.stdin.close()
    reader.wait()
    reader.stdout.close()


A, B = "/a/skin", "/b/skin"


def frames(patch: str, count: int = 10) -> list[Heard]:
    """Untouched, one every 0.1 s."""
    return [
        Heard(CONTACTS, patch, 0.1 * number, 10 + number, sequence=7 + number, untouched=True)
        for number in range(count)
    ]


def test_losses_are_known_by_gaps_and_untold_ones_are_found() -> None:
    truth = frames(A)
    heard = [*truth[:4], *truth[6:]]
    came = arrivals(CONTACTS, A, heard)
    assert (came.sent, came.arrived, came.lost, came.disordered) == (10, 8, 2, 0)
    assert untold(A, truth, heard + frames(B)) == untold(A, truth, []) == 0
    hidden = [*truth[:4], *(replace(f, sequence=f.sequence - 2) for f in truth[6:])]
    assert untold(A, truth, hidden) == 2
    assert untold(A, truth[:5], heard) == 0  # the truth may come later
    assert arrivals(CONTACTS, A, [*truth, truth[3]]).disordered == 1


def body(sent_s: float, **content: object) -> Heard:
    return Heard(BODY_CONTACTS, BODY, sent_s, **content)  # type: ignore[arg-type]


def test_a_claim_that_no_patch_bears_out_is_found() -> None:
    pressed = [replace(f, untouched=False, touched=True) for f in frames(B)[5:]]
    truth = frames(A) + frames(B)[:5] + pressed
    right = [
        body(0.45, untouched=True),
        body(0.55, untouched=True),  # as B was a moment ago
        body(0.55, touched=True),
        body(0.9),  # it need not know
    ]
    assert false_claims(truth, right, [A, B], 0.2) == []
    for wrong in (body(0.8, untouched=True), body(0.3, touched=True), body(2.0, untouched=True)):
        assert false_claims(truth, [wrong], [A, B], 0.2) == [wrong]


def test_a_claim_about_a_patch_that_is_cut_off_is_found() -> None:
    right = [body(1.1, untouched=True), body(2.0, absent=[B]), body(2.0, absent=[B], touched=True)]
    assert deaf_claims(right, [B], 1.0, 3.0, 0.5) == []
    for wrong in (body(2.0), body(2.0, absent=[A]), body(2.0, absent=[B], untouched=True)):
        assert deaf_claims([wrong], [B], 1.0, 3.0, 0.5) == [wrong]
