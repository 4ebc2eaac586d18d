# SPDX-License-Identifier: Apache-2.0

"""Messages of many senders, published in step."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.messages.rounds import Rounds


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


@given(st.lists(st.tuples(st.floats(0.005, 0.2), st.floats(0, 0.01)), min_size=1, max_size=5))
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
