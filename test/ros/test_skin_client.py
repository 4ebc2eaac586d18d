# SPDX-License-Identifier: Apache-2.0

"""SkinClient beside a real driver: touch and its validity, frames, tare, lifecycle."""

import math
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
import pytest
from rclpy.node import Node

from tactile_cdma import Refusal
from tactile_cdma.base.errors import ParameterError, PortError
from tactile_cdma.msg import TactileContact, TactileContacts
from tactile_cdma.ros import client as client_module
from tactile_cdma.ros.client import SkinClient, Touch
from tactile_cdma.ros.driver.node import SkinNode
from tactile_cdma.srv import Tare
from test.support.skin_client import running
from test.support.spinning import as_its_process, living, spinning
from test.support.waiting import wait_for


def test_touch_is_sure_while_it_is_felt_and_never_while_the_skin_is_silent() -> None:
    felt: list[Touch] = []
    with running(port="sim://?scene=all&threshold=0") as (_, node):
        skin = SkinClient(node, on_touch=felt.append, frames=True)
        first = skin.touch
        assert first.is_sure or "silent" in first.problem
        wait_for(lambda: skin.touch.is_sure and skin.touch.touched and skin.frame)
        assert skin.touch.force_n[2] < -0.1 and skin.touch.pressure_pa > 1e3
        frame = skin.frame
        assert frame is not None and frame.valid.all() and skin.info is not None
        assert frame.pressure_pa.max() == pytest.approx(skin.touch.pressure_pa, rel=0.5)
        assert frame.positions_m.shape == (16, 3) and frame.areas_m2.min() > 0
        assert skin.state() == "active"
        assert skin.change("deactivate") and skin.state() == "inactive"
        silent_s = time.monotonic()
        wait_for(lambda: not skin.touch.is_sure)
        assert time.monotonic() - silent_s < 2.0
        assert not skin.touch.touched and np.isnan(skin.touch.force_n).all()
        assert skin.touch.pressure_pa == skin.touch.speed_m_s == 0.0
        wait_for(lambda: felt[-1].contacts is None)  # told without being asked
        assert skin.frame is None
        assert not skin.change("deactivate"), "not possible now"
        assert skin.change("activate")
        wait_for(lambda: skin.touch.is_sure)
        wrong: tuple[tuple[str, Callable[[Any], object], Iterable[Any]], ...] = (
            ("node", SkinClient, (None, "skin", True)),
            ("skin", partial(SkinClient, node), (None, 5, "", "/", "left palm", b"x")),
            ("on_touch", partial(SkinClient, node, "/skin"), ("feel", 5)),
            ("frames", lambda x: SkinClient(node, frames=x), ("no", 1, None)),
            (
                "silent_after_s",
                lambda x: SkinClient(node, silent_after_s=x),
                (0, -1.0, np.nan, "1"),
            ),
            ("force", skin.tare, ("no", 1, None)),
            ("wait_s", lambda x: skin.tare_async(wait_s=x), (-1.0, np.nan, np.inf, "1", 1e300)),
            ("transition", skin.change, (None, [], 3, "start")),
        )
        subscriptions = list(node.subscriptions)
        for name, call, values in wrong:
            for value in values:
                with pytest.raises(ParameterError, match=name):
                    call(value)
        assert list(node.subscriptions) == subscriptions, "of no client that was refused"


def test_a_skin_that_is_blind_in_part_is_not_sure_of_anything() -> None:
    with running(port="sim://?scene=all&threshold=0&dead=7") as (_, node):
        skin = SkinClient(node)
        wait_for(lambda: skin.touch.touched)
        assert not skin.touch.is_sure
        assert skin.touch.problem == "blind: 15 of 16 taxels in service have a certain reading"
        publisher = node.create_publisher(TactileContacts, "/skin/contacts", 10)
        publisher.publish(TactileContacts(touched=True))  # contradicts itself, and ends nobody
        time.sleep(0.1)
        assert skin.touch.touched


@pytest.mark.parametrize("wrong", ["force", "pressure", "speed", "absent", ""])
def test_an_amount_that_is_unknown_is_not_sure(wrong: str) -> None:
    contact = TactileContact(age=1.0, pressure_max=5e3, taxels=[1])
    message = TactileContacts(taxels_in_service=16, taxels_valid=16, touched=True)
    if wrong == "force":
        message.wrench.force.z = math.nan
    elif wrong == "pressure":
        contact.pressure_max = math.nan
    elif wrong == "speed":
        contact.velocity.y = math.nan
    message.contacts, message.absent = [contact], ["palm"] if wrong == "absent" else []
    node = Node("touched")
    with spinning([node]):
        skin = SkinClient(node, "/other", silent_after_s=60.0)
        publisher = node.create_publisher(TactileContacts, "/other/contacts", 10)
        wait_for(publisher.get_subscription_count)
        publisher.publish(message)
        wait_for(lambda: skin.touch.contacts is not None)
        assert skin.touch.touched and skin.touch.is_sure == (not wrong), skin.touch.problem


def test_a_tare_waits_for_what_passes_while_the_node_serves_others() -> None:
    with running(port="sim://?scene=idle&heartbeat=2", autostart=False) as (_, client):
        skin = SkinClient(client)
        assert skin.tare(wait_s=0.5).reason == Refusal.INACTIVE
        assert skin.change("configure") and skin.change("activate")
        early = skin.tare()
        assert (early.success, early.reason) in (
            (False, Tare.Response.REASON_EARLY),
            (False, Tare.Response.REASON_NO_FRAMES),
        )
        future = skin.tare_async(wait_s=20.0)
        assert skin.state() == "active" and not future.done()
        wait_for(future.done)
        answer = future.result()
        assert answer.success and answer.reason == Tare.Response.REASON_NONE
        assert len(answer.offset) == 16


def test_reasons_of_the_service_are_those_of_python() -> None:
    for reason in Refusal:
        assert getattr(Tare.Response, f"REASON_{reason.name}") == reason


def test_the_nodes_own_executor_answers_later_too() -> None:
    """As skin_driver runs it; the tests above spin by rclpy's."""
    client = Node("asker")
    with as_its_process(SkinNode()), spinning([client]):
        skin, begun_s = SkinClient(client), time.monotonic()
        answer = skin.tare(wait_s=0.35)
        assert not answer.success and answer.reason in (3, 4)  # too early in any case
        assert 0.35 <= time.monotonic() - begun_s < 5.0
        assert skin.tare(wait_s=20.0).success


def test_services_that_do_not_answer_end_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "ANSWER_S", 0.3)
    with running(autostart=False) as (_, node):
        with pytest.raises(PortError, match="no /palm/skin/tare: does the driver run"):
            SkinClient(node, "/palm/skin").tare()
        wait_for(lambda: node.count_publishers("/skin/contacts"))
        late = pytest.raises(PortError, match=r"did not answer within 0\.3 s; does another thread")
        with living(Node("alone")) as alone, late:  # nobody spins it
            SkinClient(alone).state()
