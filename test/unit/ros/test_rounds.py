# SPDX-License-Identifier: Apache-2.0

"""Messages of many senders, published in step."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.ros.body.rounds import Rounds


class Gatherer:
    """Keeps each sender's latest message and what is published, as a node would."""

    def __init__(self, silent_after_s: float) -> None:
        self.rounds = Rounds(silent_after_s)
        self.latest: dict[str, float] = {}
        self.out: list[tuple[float, dict[str, float]]] = []

    def take(self, sender: str, now_s: float) -> None:
        if self.rounds.is_due_before(sender):
            self.publish(now_s)
        self.latest[sender] = now_s
        if self.rounds.add(sender, now_s):
            self.publish(now_s)

    def publish(self, now_s: float) -> None:
        self.rounds.end()
        present = self.rounds.present(self.latest, now_s)
        self.out.append((now_s, {name: self.latest[name] for name in present}))


def gathered(arrivals: list[tuple[float, str]], silent_after_s: float = 1.0) -> Gatherer:
    gatherer = Gatherer(silent_after_s)
    for now_s, sender in sorted(arrivals):
        gatherer.take(sender, now_s)
    return gatherer


def steady(sender: str, period_s: float, phase_s: float, end_s: float) -> list[tuple[float, str]]:
    return [(phase_s + i * period_s, sender) for i in range(int((end_s - phase_s) / period_s))]


def test_senders_of_one_pace_make_one_message_per_period() -> None:
    arrivals = [news for i in range(8) for news in steady(f"p{i}", 0.01, i * 1e-3, 1.0)]
    out = gathered(arrivals).out[8:]
    assert 90 <= len(out) <= 100
    for now_s, latest in out:
        assert len(latest) == 8
        assert now_s - min(latest.values()) < 0.01


@given(
    st.lists(st.tuples(st.floats(0.005, 0.2), st.floats(0, 0.01)), min_size=1, max_size=5),
)
def test_every_message_goes_out_once_unless_a_quicker_sender_needs_it_again(
    senders: list[tuple[float, float]],
) -> None:
    """Nothing is skipped; and rounds come no faster than the senders, nor slower than any."""
    arrivals = [
        news for i, sender in enumerate(senders) for news in steady(f"p{i}", *sender, end_s=1.0)
    ]
    gatherer = gathered(arrivals)
    gatherer.publish(1.0)
    shown = {(name, stamp) for _, latest in gatherer.out for name, stamp in latest.items()}
    assert shown == {(name, stamp) for stamp, name in arrivals}
    counts = Counter(name for _, name in arrivals)
    assert max(counts.values()) <= len(gatherer.out) <= 2 * max(counts.values()) + len(senders) + 1


def test_a_sender_that_falls_silent_holds_nobody_up() -> None:
    arrivals = steady("a", 0.01, 0.0, 3.0) + steady("b", 0.01, 0.005, 1.0)
    gatherer = gathered(arrivals, silent_after_s=0.5)
    late = [(now_s, latest) for now_s, latest in gatherer.out if now_s > 1.5]
    assert all(latest.keys() == {"a"} and latest["a"] == now_s for now_s, latest in late)
    waiting = [now_s for now_s, _ in gatherer.out if 1.0 < now_s < 1.5]
    assert len(waiting) >= 48  # while b is waited for, a's pace is kept


def test_the_silence_of_a_sender_never_heard_is_infinite() -> None:
    rounds = Rounds(1.0)
    assert rounds.present(["a"], 1e9) == []
    rounds.add("a", 5.0)
    assert rounds.present(["a", "b"], 6.0) == ["a"]
    assert rounds.present(["a", "b"], 6.1) == []
    rounds.forget()
    assert rounds.present(["a"], 5.0) == []
    assert not rounds.is_due_before("a")


class Sleeper(Gatherer):
    """Is woken by awaited senders alone; the others' messages, at most two, wait to be polled."""

    def __init__(self, senders: set[str], silent_after_s: float) -> None:
        super().__init__(silent_after_s)
        self.waiting: dict[str, deque[float]] = {name: deque(maxlen=2) for name in senders}
        self.awaited, self.wakes = senders, 0

    def arrive(self, sender: str, now_s: float) -> None:
        self.waiting[sender].append(now_s)
        while woken := [name for name in sorted(self.awaited) if self.waiting[name]]:
            self.wakes += 1
            for name in self.waiting.keys() - self.awaited:
                while self.waiting[name]:
                    self.take(name, self.waiting[name].popleft())
            self.take(woken[0], self.waiting[woken[0]].popleft())
            self.awaited = self.rounds.awaited(self.waiting)


def slept(arrivals: list[tuple[float, str]]) -> Sleeper:
    sleeper = Sleeper({name for _, name in arrivals}, silent_after_s=1.0)
    for now_s, sender in sorted(arrivals):
        sleeper.arrive(sender, now_s)
    return sleeper


@given(st.lists(st.floats(0.0, 0.0099), min_size=3, max_size=8, unique=True))
def test_senders_in_order_need_fewer_wakes_for_timely_rounds(
    phases_s: list[float],
) -> None:
    arrivals = [n for i, phase_s in enumerate(phases_s) for n in steady(f"p{i}", 0.01, phase_s, 1)]
    sleeper = slept(arrivals)
    late = [(now_s, latest) for now_s, latest in sleeper.out if now_s > 0.5]
    assert 49 <= len(late) <= 51
    for now_s, latest in late:
        assert len(latest) == len(phases_s)
        assert now_s - min(latest.values()) < 0.0101
    assert sleeper.wakes < 2 * 100 + 5 * len(phases_s)


@given(st.integers(0, 4), st.floats(0.3, 0.7))
def test_whoever_falls_silent_the_awaited_keep_the_pace(silent: int, until_s: float) -> None:
    """The one that is awaited to complete the round, too."""
    ends_s = [until_s if i == silent else 1.0 for i in range(5)]
    arrivals = [n for i in range(5) for n in steady(f"p{i}", 0.01, i * 1e-3, ends_s[i])]
    out = slept(arrivals).out
    assert max(np.diff([now_s for now_s, _ in out])) < 0.0201
    final_s, latest = out[-1]
    assert all(final_s - latest[f"p{i}"] < 0.0201 for i in range(5) if i != silent)


def test_a_quicker_sender_is_noticed() -> None:
    """Its pace is kept once it has sent twice in a round."""
    arrivals = [n for i in range(4) for n in steady(f"p{i}", 0.01, i * 1e-3, 2.0)]
    arrivals += [(1.0 + 0.0025 * i + 0.0001, "p1") for i in range(400)]
    out = slept(arrivals).out
    quick = [now_s for now_s, _ in out if 1.1 < now_s < 1.9]
    assert len(quick) > 0.9 * len([a for a, n in arrivals if n == "p1" and 1.1 < a < 1.9])
