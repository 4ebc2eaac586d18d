# SPDX-License-Identifier: Apache-2.0

"""Recovery: after any fault on the line, correct frames resume without intervention.

A session and a pipeline talk to a virtual digitizer over a line of bytes, in virtual time, while
both ends and all between them misbehave in any order.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import PacketType, Result, SyncMode
from tactile_cdma.wire.messages import (
    Ack,
    Configure,
    FrameLayout,
    GetInfo,
    Packet,
    Samples,
    Start,
    Status,
    Stop,
)
from tactile_cdma.wire.packets import PacketWriter
from test.support.simulated import Truth

SKINS = {"raw": {"samples_per_chip": 4}, "integrated": {"samples_per_chip": 1}}
SMALL = {"nodes": 3, "bits": 8, "chip_us": 100.0, "frame_period_ms": 40.0}
STEP_S = 0.01
RECOVERY_S = 3.0
"""A STATUS per second, an answer that is waited for, and what may have been under way."""
LOOK_S = 0.4


class Talk:
    """A line and both its ends, from power-up on."""

    def __init__(self, config: SkinConfig) -> None:
        self.config, self.now_s, self.frames = config, 50.0, list[TactileFrame]()
        self.pipeline, self.session = Pipeline(config), Session(config)
        self.deaf_until_s = self.mute_until_s = self.delay_s = 0.0
        self._under_way: deque[tuple[float, bytes]] = deque()
        self._sent = b""
        self.reset()
        self.ask(self.session.open())

    def reset(self) -> None:
        """The digitizer's power fails for a moment."""
        self.began_s = self.now_s
        options = SimOptions(scene="all", threshold=0, seed=int(self.now_s))
        self.digitizer = VirtualDigitizer(options, lambda: self.now_s)

    def ask(self, data: bytes) -> None:
        if self.now_s >= self.mute_until_s:
            self.digitizer.receive(data)

    def say(self, data: bytes) -> None:
        """These bytes are on their way to the host."""
        self._under_way.append((self.now_s + self.delay_s, data))

    def say_again(self, count: int) -> None:
        self.say(self._sent[-count:])

    def go_on(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            self.digitizer.advance()
            data = self.digitizer.take(self.digitizer.pending)
            self._sent = (self._sent + data)[-4096:]
            if self.now_s >= self.deaf_until_s:
                self.say(data)
            while self._under_way and self._under_way[0][0] <= self.now_s:
                self.frames += self.pipeline.feed(self._under_way.popleft()[1], self.now_s)
            self.ask(self.session.watch(self.pipeline, self.now_s))

    def reconnect(self) -> None:
        """As the driver does when the port was gone."""
        self._under_way.clear()
        self.pipeline.reconnected()
        self.session = Session(self.config)
        self.ask(self.session.open())

    def mend(self) -> None:
        self.deaf_until_s = self.mute_until_s = self.delay_s = 0.0


@dataclass(frozen=True)
class Event:
    """What happens: a method of Talk, or an attribute of it that is set."""

    name: str
    value: object = None

    def happen(self, talk: Talk) -> None:
        if self.name in ("deaf_until_s", "mute_until_s"):
            assert isinstance(self.value, float)
            setattr(talk, self.name, talk.now_s + self.value)
        elif self.name == "delay_s":
            talk.delay_s = self.value
        elif self.value is None:
            getattr(talk, self.name)()
        else:
            getattr(talk, self.name)(self.value)


def _numbered(packets: st.SearchStrategy[Packet]) -> st.SearchStrategy[bytes]:
    """An intact packet of another sender, or of the same one with a wrong number."""
    numbers = st.sampled_from([0, 1, 60, 65_535])
    return st.builds(lambda n, p: b"\0" + PacketWriter(n).encode(p), numbers, packets)


def events(config: SkinConfig) -> st.SearchStrategy[Event]:
    layout = FrameLayout.of(config.spec, config.samples_per_chip)
    integrated = config.samples_per_chip == 1
    configure = Configure(layout, SyncMode.DRIVE, integrated)
    other = replace(configure, frame=replace(layout, bits=9))
    digitizer = VirtualDigitizer(SimOptions(), lambda: 0.0)
    digitizer.receive(PacketWriter().encode(configure))
    info = digitizer.info()
    infos = st.sampled_from(
        [
            info,
            replace(info, volts_per_count=0.0),
            replace(info, sample_rate_uhz=2 * info.sample_rate_uhz),
            replace(info, frame=other.frame),
            replace(info, version=9),
        ]
    )
    counts = np.arange(200, dtype=np.int16) * np.int16(97)
    samples = st.builds(
        Samples,
        st.sampled_from([0, 10**6, 2**52, 2**63]),
        st.sampled_from([0, 10_000, 2**53, 2**64 - 1]),
        st.just(counts),
        sync=st.booleans(),
    )
    statuses = st.builds(Status, st.sampled_from([0, 10**6, 2**63]), streaming=st.booleans())
    kinds = st.sampled_from([PacketType.START, PacketType.CONFIGURE, PacketType.PACK])
    acks = st.builds(Ack, kinds, st.just(0), st.sampled_from(Result))
    commands = st.sampled_from([Stop(), Start(), GetInfo(), configure, other])
    spans = st.sampled_from([0.02, 0.1, 0.5, 1.2])
    return st.one_of(
        st.builds(Event, st.just("go_on"), spans),
        st.builds(Event, st.sampled_from(["deaf_until_s", "mute_until_s"]), spans),
        st.builds(Event, st.just("delay_s"), st.sampled_from([0.0, 0.1, 1.5])),
        st.builds(Event, st.sampled_from(["reset", "reconnect"])),
        st.builds(Event, st.sampled_from(["say", "ask"]), st.binary(max_size=40)),
        st.builds(Event, st.just("say"), _numbered(st.one_of(infos, samples, statuses, acks))),
        st.builds(Event, st.just("ask"), _numbered(commands)),
        st.builds(Event, st.just("say_again"), st.sampled_from([50, 4096])),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SKINS)
@settings(max_examples=4)
@given(data=st.data())
def test_frames_come_again_by_themselves(name: str, data: st.DataObject) -> None:
    config = SkinConfig.of(SMALL | SKINS[name])
    talk = Talk(config)
    for event in data.draw(st.lists(events(config), max_size=12)):
        event.happen(talk)
    talk.mend()
    talk.go_on(RECOVERY_S)
    before, lost = len(talk.frames), talk.pipeline.counters.lost_frames
    talk.go_on(LOOK_S)
    frames = talk.frames[before:]
    assert len(frames) == pytest.approx(LOOK_S / config.spec.frame_period_s, abs=1)
    assert talk.pipeline.problem is None
    assert talk.pipeline.counters.lost_frames == lost
    truth = Truth(talk.digitizer)
    for frame in frames:
        since_s = frame.t_start - talk.digitizer.started_s
        true = truth[round(since_s / config.spec.frame_period_s)]
        assert since_s == pytest.approx(true.start_s, abs=config.spec.chip_s)
        assert np.array_equal(frame.words.active, true.active)
        assert np.array_equal(frame.words.codes, true.codes)
        assert frame.t_host - talk.began_s == pytest.approx(frame.t_middle, abs=2 * STEP_S)
    assert (np.diff([frame.sequence for frame in frames]) == 1).all()
    assert (np.diff([frame.t_host for frame in talk.frames]) > 0).all()
