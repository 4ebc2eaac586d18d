# SPDX-License-Identifier: Apache-2.0

"""Calls of the classes that need ROS, in any order, as those of call_orders.

Beside an impostor that is a driver for them, whose messages are of now, or not, or contradict
themselves.
"""

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest import mock

from hypothesis import strategies as st
from hypothesis.stateful import rule
from rclpy.context import Context
from rclpy.node import Node

from tactile_cdma import ObservationError
from tactile_cdma.msg import TactileContacts
from tactile_cdma.ros import client
from tactile_cdma.ros.client import SkinClient, Touch
from tactile_cdma.ros.common.background import Background
from tactile_cdma.ros.observation import TopicObservation

from .call_orders import Calls, Observing
from .impostor import Impostor
from .spinning import spinning
from .waiting import holds, wait_for

ANSWER_S = 0.02
"""For a service, where there is none: short, as many calls wait that long."""


class Heard(Calls):
    """Calls of what hears the impostor."""

    served = ExitStack()
    impostor: Impostor | None = None
    number = 0

    @property
    def driver(self) -> Impostor:
        """The impostor, who lives until he is ended."""
        if Heard.impostor is None:
            context = Context()  # of another program than what hears it
            context.init()
            Heard.served.callback(context.try_shutdown)
            node = Node("impostor", context=context)
            Heard.served.enter_context(spinning([node]))
            Heard.impostor = Impostor(node)
        return Heard.impostor

    @staticmethod
    def end_impostor() -> None:
        """Others who are a driver of this name would not be the only one."""
        Heard.served.close()
        Heard.impostor = None

    @rule(
        age_s=st.sampled_from([0.0, 0.0, 5.0, -5.0]),
        uncertainty_s=st.sampled_from([0.0, math.inf, math.nan]),
        count=st.integers(1, 3),
        again=st.booleans(),
    )
    def hears(self, age_s: float, uncertainty_s: float, count: int, again: bool) -> None:
        for _ in range(count):
            Heard.number += not again
            self.driver.send(Heard.number, age_s, uncertainty_s)
        time.sleep(0.005)

    @rule()
    def hears_a_contradiction(self) -> None:
        self.driver.contacts.publish(TactileContacts(touched=True, untouched=True))

    def heard(self, condition: Callable[[], object]) -> None:
        """Wait, while frames of now come, until the condition holds."""

        def sent() -> bool:
            Heard.number += 1
            self.driver.send(Heard.number)
            return holds(condition)

        wait_for(sent)


class SkinClientCalls(Heard):
    """Calls of SkinClients of one node, which may be gone."""

    def __init__(self) -> None:
        super().__init__()
        assert self.driver
        self.background = Background("caller")
        self.background.start()
        self.felt: list[Touch] = []
        self.skin = SkinClient(self.background.node, "/other")
        self.patches = mock.patch.object(client, "ANSWER_S", ANSWER_S)
        self.patches.start()

    @rule(
        name=st.sampled_from(["/other", "/nobody", "not a name", ""]),
        feels=st.sampled_from([None, "list", "raises"]),
        frames=st.booleans(),
        silent_after_s=st.sampled_from([0.02, 0.5, math.inf, -1.0]),
    )
    def is_made(self, name: str, feels: str | None, frames: bool, silent_after_s: float) -> None:
        def fail(_: Touch) -> None:
            raise ValueError("a program's own mistake")

        on_touch = {"list": self.felt.append, "raises": fail}.get(feels or "")
        node = self.background.node
        made = self.attempt(lambda: SkinClient(node, name, on_touch, frames, silent_after_s))
        self.skin = made or self.skin

    @rule(name=st.sampled_from(["touch", "frame", "info"]))
    def is_looked_at(self, name: str) -> None:
        found = self.attempt(lambda: getattr(self.skin, name))
        if isinstance(found, Touch):
            assert found.is_sure or found.problem

    @rule(force=st.booleans(), wait_s=st.sampled_from([0.0, 0.01, -1.0, math.nan]))
    def tares(self, force: bool, wait_s: float) -> None:
        self.attempt(lambda: self.skin.tare(force, wait_s))
        self.attempt(lambda: self.skin.tare_async(force, wait_s))

    @rule(transition=st.sampled_from(["activate", "deactivate", "nonsense", 3]))
    def changes(self, transition: Any) -> None:
        self.attempt(self.skin.state)
        self.attempt(lambda: self.skin.change(transition))

    @rule()
    def loses_its_node(self) -> None:
        self.background.close()

    def teardown(self) -> None:
        self.patches.stop()
        self.background.close()
        fresh = Background("caller")
        fresh.start()
        skin = SkinClient(fresh.node, "/other", frames=True)
        self.heard(lambda: skin.touch.is_sure and skin.frame is not None)
        fresh.close()


class TopicObservationCalls(Heard, Observing):
    """Calls of a TopicObservation, whose context somebody may shut down."""

    def __init__(self) -> None:
        super().__init__()
        assert self.driver
        self.observation = TopicObservation.of({"other": "/other"}, contacts=True)

    @rule()
    def opens(self) -> None:
        self.observation.open()

    @rule()
    def closes(self) -> None:
        self.observation.close()

    @rule(fails=st.booleans())
    def is_entered(self, fails: bool) -> None:
        def work() -> None:
            with self.observation as observation:
                if fails:
                    observation.at(-1)

        self.attempt(work)

    @rule()
    def is_shut_down(self) -> None:
        if (background := self.observation._background) is not None:
            context: Context = background._context
            context.try_shutdown()  # as rclpy's handler of signals does

    def teardown(self) -> None:
        self.observation.close()
        with self.observation as observation:

            def observed() -> bool:
                try:
                    found = observation.read(now=True)
                except ObservationError:
                    return False
                return bool(found["observation.tactile.other.valid"].all())

            self.heard(observed)


MACHINES = {"SkinClient": SkinClientCalls, "TopicObservation": TopicObservationCalls}
