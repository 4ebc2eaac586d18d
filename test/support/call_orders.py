# SPDX-License-Identifier: Apache-2.0

"""Public calls in any order: before open, after close, twice, after an error.

Each machine of hypothesis makes one object, and its rules are the calls. A call may raise a
TactileError; whatever it raised, the object has to work afterwards, as a test of what came tells.
"""

import asyncio
import contextlib
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test

from tactile_cdma import Body, Decoder, Frame, LiveObservation, Skin, TactileError, body
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim import Sphere
from tactile_cdma.sim.batch.skin_batch import SkinBatch
from tactile_cdma.sim.options import SimOptions

from . import simulated
from .waiting import wait_for

NODES, FRAMES = 16, 60
CONFIG = SkinConfig.of({"nodes": NODES})
STEPPED = "sim://?scene=external&speed=0"
TIMEOUT_S = 0.2
"""For a frame, where none may come: short, as many calls wait that long."""


class Calls(RuleBasedStateMachine):
    """Calls of one object; refused: kinds of errors that a call may raise."""

    refused: tuple[type[Exception], ...] = (TactileError,)

    def attempt(self, call: Callable[[], Any]) -> Any:
        """Make a call; returns None where it is refused, with a reason."""
        try:
            return call()
        except self.refused as error:
            assert str(error)
            return None


def try_orders(machine: type[Calls], orders: int, steps: int = 15, **rules: Any) -> None:
    """Try so many orders of at most so many calls; rules: more settings of hypothesis."""
    every = list(HealthCheck)
    how = {"stateful_step_count": steps, "deadline": None, "suppress_health_check": every} | rules
    run_state_machine_as_test(machine, settings=settings(max_examples=orders, **how))


class DecoderCalls(Calls):
    """feed and flush of a Decoder, with bytes whole, cut, damaged, or none."""

    stream: bytes = b""

    def __init__(self) -> None:
        super().__init__()
        if not self.stream:
            type(self).stream = simulated.stream(CONFIG, "sim://?scene=all&seed=3", FRAMES)
        self.decoder = Decoder(nodes=NODES, contacts=True)
        self.at, self.t_host = 0, 0.0

    def feed(self, data: bytes) -> None:
        self.t_host += 0.01
        for frame in self.decoder.feed(data, self.t_host):
            assert isinstance(frame, Frame)

    @rule(size=st.integers(0, 20_000))
    def goes_on(self, size: int) -> None:
        self.feed(self.stream[self.at : self.at + size])
        self.at = (self.at + size) % len(self.stream)

    @rule(skip=st.integers(1, 60_000))
    def loses(self, skip: int) -> None:
        self.at = (self.at + skip) % len(self.stream)

    @rule(noise=st.binary(max_size=200))
    def hears_noise(self, noise: bytes) -> None:
        self.feed(noise)

    @rule()
    def flushes(self) -> None:
        self.decoder.flush()

    @rule(data=st.sampled_from([7, "text", None, np.zeros(3)]))
    def is_fed_no_bytes(self, data: Any) -> None:
        self.attempt(lambda: self.decoder.feed(data, self.t_host))

    @rule(t_host=st.sampled_from([float("nan"), float("inf"), "now", -5.0]))
    def is_fed_at_no_time(self, t_host: Any) -> None:
        self.attempt(lambda: self.decoder.feed(b"\0", t_host))

    @rule()
    def is_looked_at(self) -> None:
        assert self.decoder.layout is not None and self.decoder.problem != ""

    def teardown(self) -> None:
        self.decoder.flush()
        self.t_host += 5.0
        frames = len(self.decoder.feed(self.stream, self.t_host)) + len(self.decoder.flush())
        assert frames > FRAMES / 2, f"{frames} of {FRAMES} frames"


class SkinCalls(Calls):
    """Calls of a Skin: of a simulator, one that is stepped, a recording, a port that is none."""

    recording: Path | None = None

    def __init__(self) -> None:
        super().__init__()
        if self.recording is None:
            path = Path(tempfile.mkdtemp()) / "touch.skin"
            type(self).recording = simulated.recording(path, SimOptions(seed=3), 0.5)
        self.skin = Skin(STEPPED, nodes=NODES, timeout_s=TIMEOUT_S)
        self.contexts = contextlib.ExitStack()

    @rule(
        port=st.sampled_from([STEPPED, "sim://", "replay://{}?speed=0", "/nowhere"]),
        contacts=st.booleans(),
        opened=st.integers(0, 3),
    )
    def is_made(self, port: str, contacts: bool, opened: int) -> None:
        self.contexts.close()
        self.skin.close()
        port = port.format(self.recording)
        self.skin = Skin(port, nodes=NODES, contacts=contacts, timeout_s=TIMEOUT_S)
        if opened:
            self.attempt(self.skin.open)

    @rule(patiently=st.booleans())
    def opens(self, patiently: bool) -> None:
        self.attempt(lambda: self.skin.open(patiently))

    @rule()
    def closes(self) -> None:
        self.skin.close()

    @rule(name=st.sampled_from(["read", "newest", "latest", "waiting"]))
    def reads(self, name: str) -> None:
        self.attempt(getattr(self.skin, name))

    @rule()
    def iterates(self) -> None:
        self.attempt(lambda: next(iter(self.skin), None))

    @rule()
    def iterates_beside_others(self) -> None:
        async def first() -> Frame | None:
            async for frame in self.skin:
                return frame
            return None

        self.attempt(lambda: asyncio.run(first()))

    @rule(force=st.booleans())
    def tares(self, force: bool) -> None:
        self.attempt(lambda: self.skin.tare(force))

    @rule(steps=st.booleans())
    def is_pressed(self, steps: bool) -> None:
        ball = Sphere(radius_m=0.02, position_m=(0.0, 0.0, 0.019))
        self.attempt(lambda: (self.skin.step if steps else self.skin.press)(ball))

    @rule()
    def is_listened_to(self) -> None:
        self.attempt(lambda: self.contexts.enter_context(self.skin.telling(lambda: None)))

    @rule()
    def is_not_listened_to(self) -> None:
        self.contexts.close()

    @rule(fails=st.booleans())
    def is_entered(self, fails: bool) -> None:
        def work() -> None:
            with self.skin as skin:
                assert skin is self.skin
                if fails:
                    skin.tare(wait_s=-1.0)

        self.attempt(work)

    @rule(name=st.sampled_from(["problem", "silence", "ended", "source", "dropped", "tared"]))
    def is_looked_at(self, name: str) -> None:
        self.attempt(lambda: getattr(self.skin, name))
        assert repr(self.skin)

    def teardown(self) -> None:
        self.contexts.close()
        self.skin.close()
        if self.skin.port.startswith("/"):
            return
        self.skin.timeout_s = 20.0
        with self.skin as skin:
            frame = skin.step() if skin.port == STEPPED else skin.read()
            assert frame.pressure_pa.shape == (NODES,)


class BodyCalls(Calls):
    """Calls of a Body whose second patch is a port that is none."""

    def __init__(self) -> None:
        super().__init__()
        path = Path(tempfile.mkdtemp()) / "body.yaml"
        patch = "{parameters: {nodes: 16, port: '%s'}}"
        path.write_text(
            f"frame_id: base\npatches: {{a: {patch % 'sim://'}, b: {patch % '/nowhere'}}}"
        )
        self.body = Body(path, timeout_s=TIMEOUT_S)
        for skin in self.body.skins.values():
            skin.timeout_s = TIMEOUT_S
        self.patches = mock.patch.object(body, "FIRST_S", TIMEOUT_S)
        self.patches.start()

    @rule()
    def opens(self) -> None:
        self.attempt(self.body.open)

    @rule()
    def closes(self) -> None:
        self.body.close()

    @rule()
    def reads(self) -> None:
        self.attempt(self.body.read)

    @rule()
    def iterates(self) -> None:
        self.attempt(lambda: next(iter(self.body), None))

    @rule(fails=st.booleans())
    def is_entered(self, fails: bool) -> None:
        def work() -> None:
            with self.body as body:
                if fails:
                    body.skins["b"].read()

        self.attempt(work)

    @rule(name=st.sampled_from(["a", "b"]))
    def closes_one(self, name: str) -> None:
        self.body.skins[name].close()

    def teardown(self) -> None:
        self.body.close()
        self.body.timeout_s = 20.0
        with self.body as opened:
            wait_for(lambda: opened.read().missing == ("b",))
        self.patches.stop()


class Observing(Calls):
    """Calls that every kind of observation has."""

    observation: Any

    @rule(now=st.booleans())
    def reads(self, now: bool) -> None:
        self.attempt(lambda: self.observation.read(now))

    @rule(time_ns=st.sampled_from([0, 5, 1 << 60, 1 << 62, -1, "now"]))
    def looks_at(self, time_ns: Any) -> None:
        self.attempt(lambda: self.observation.at(time_ns))

    @rule(values=st.sampled_from([[], [1.0], {"a": 1.0}, "text", None]))
    def is_told_a_state(self, values: Any) -> None:
        self.attempt(lambda: self.observation.state(values))

    @rule()
    def is_looked_at(self) -> None:
        assert isinstance(self.observation.notes, list) and repr(self.observation)


class ObservationCalls(Observing):
    """Calls of a LiveObservation, and of its skin, which it does not open."""

    def __init__(self) -> None:
        super().__init__()
        self.skin = Skin(STEPPED, nodes=NODES, contacts=True, timeout_s=TIMEOUT_S)
        self.observation = LiveObservation.of(self.skin)
        self.skin.open()
        self.frames = [self.skin.step()]

    @rule()
    def opens(self) -> None:
        self.skin.open()

    @rule()
    def closes(self) -> None:
        self.skin.close()

    @rule()
    def steps(self) -> None:
        if (frame := self.attempt(self.skin.step)) is not None:
            self.frames.append(frame)

    @rule(stamp_ns=st.sampled_from([None, 0, 1, 1 << 62, -1, 1.5]))
    def takes(self, stamp_ns: Any) -> None:
        for frame in self.frames[-1:]:  # one after the other, or the same one twice
            self.attempt(lambda frame=frame: self.observation.take(frame, stamp_ns=stamp_ns))

    def teardown(self) -> None:
        self.skin.close()
        self.skin.timeout_s = 20.0
        with self.skin:
            fresh = LiveObservation.of(self.skin)
            fresh.take(self.skin.step(), stamp_ns=time.time_ns())  # sure, so that the skin begins
            assert fresh.read(now=True)["observation.tactile.skin"].size == NODES


class BatchCalls(Calls):
    """Calls of a SkinBatch, with states of another one, and arrays of other kinds, too."""

    def __init__(self) -> None:
        super().__init__()
        self.batches = [SkinBatch(CONFIG, envs) for envs in (2, 3)]
        like = np.zeros(1, np.float32)
        self.states: list[Any] = [None, 7, *(batch.begin(like) for batch in self.batches)]

    @rule(which=st.integers(0, 1), dtype=st.sampled_from(["f4", "f8", "i4", "?"]))
    def begins(self, which: int, dtype: str) -> None:
        found = self.attempt(lambda: self.batches[which].begin(np.zeros(1, dtype)))
        self.states.append(found)

    @rule(which=st.integers(0, 1), odd=st.integers(0, 5), data=st.data())
    def steps(self, which: int, odd: int, data: st.DataObject) -> None:
        state = data.draw(st.sampled_from(self.states))
        envs, dtype = 2 + which + (odd == 0), "f8" if odd == 1 else "f4"
        pressure_pa = np.full((envs, NODES), 9e3, dtype)
        found = self.attempt(lambda: self.batches[which].step(state, pressure_pa))
        if found is not None:
            self.states.append(found[0])

    @rule(which=st.integers(0, 1), odd=st.integers(0, 5), data=st.data())
    def resets(self, which: int, odd: int, data: st.DataObject) -> None:
        state, fresh = (data.draw(st.sampled_from(self.states)) for _ in range(2))
        done = np.ones(2 + which + (odd == 0), dtype="f4" if odd == 1 else "?")
        self.states.append(self.attempt(lambda: self.batches[which].reset(state, fresh, done)))

    def teardown(self) -> None:
        batch = self.batches[0]
        state = batch.begin(np.zeros(1, np.float32))
        for _ in range(3):
            state, frame = batch.step(state, np.full((2, NODES), 9e3, np.float32))
        assert np.isfinite(frame.pressure_pa).all()


MACHINES = {
    "Decoder": DecoderCalls,
    "Skin": SkinCalls,
    "Body": BodyCalls,
    "LiveObservation": ObservationCalls,
    "SkinBatch": BatchCalls,
}
