# SPDX-License-Identifier: Apache-2.0

"""SkinClient beside a real driver: touch and its validity, frames, tare, lifecycle."""

import math
import sys
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.clock import Clock
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from tactile_cdma import Refusal
from tactile_cdma.base.errors import ParameterError, PortError
from tactile_cdma.msg import TactileContact, TactileContacts
from tactile_cdma.ros import client as client_module
from tactile_cdma.ros.client import SILENT_S, SkinClient, Touch
from tactile_cdma.ros.common.newest import Newest
from tactile_cdma.ros.driver.node import SkinNode
from tactile_cdma.srv import Tare
from test.support.impostor import impostor
from test.support.programs import started
from test.support.skin_client import running
from test.support.spinning import as_its_process, living, spinning
from test.support.waiting import wait_for

ROOT = Path(__file__).resolve().parents[2]


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
        wait_for(lambda: not skin.touch.is_sure)
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
    with impostor(silent_after_s=60.0) as other:
        message.header.stamp = other.node.get_clock().now().to_msg()
        other.contacts.publish(message)
        wait_for(lambda: other.skin.touch.contacts is not None)
        touch = other.skin.touch
        assert touch.touched and touch.is_sure == (not wrong), touch.problem


@pytest.mark.parametrize(
    ("age_s", "uncertainty_s", "apart_s", "sure"),
    [
        (0.0, 0.0, 0.0, True),
        (0.3, 0.0, 0.0, True),
        (5.0, 0.0, 0.0, False),
        (-5.0, 0.0, 0.0, False),
        (0.7, 0.3, 0.0, True),
        (5.0, math.inf, 0.0, False),
        (5.0, math.nan, 0.0, False),
        (5.0, 0.0, 6.0, True),
        (-5.0, 0.0, 6.0, True),
        (9.0, 0.0, 6.0, False),
        (-9.0, 0.0, 6.0, False),
    ],
)
def test_frames_are_as_old_as_their_stamps(
    age_s: float, uncertainty_s: float, apart_s: float, sure: bool
) -> None:
    """However lately they came. Clients, observations, bodies and viewers ask the same class."""
    clock = Clock()
    newest = Newest(clock, SILENT_S, apart_s)
    stamp_ns = clock.now().nanoseconds - round(age_s * 1e9)
    assert newest.take(stamp_ns, (1, 7), uncertainty_s) == newest.is_of_now == sure
    assert sure or f"its stamps are {age_s:+.1f} s off this computer's time" in newest.refused


@pytest.mark.parametrize(
    ("age_s", "uncertainty_s", "apart_s", "sure"),
    [(5.0, 0.0, 0.0, False), (0.7, 0.3, 0.0, True), (5.0, 0.0, 6.0, True)],
)
def test_a_client_asks_how_old_frames_are(
    age_s: float, uncertainty_s: float, apart_s: float, sure: bool
) -> None:
    with impostor(clocks_apart_s=apart_s) as other:
        assert other.is_sure_while(lambda n: other.send(n, age_s, uncertainty_s)) == sure
        assert sure or "its stamps are +5.0 s off" in other.skin.touch.problem


def test_one_frame_again_and_again_is_not_of_now() -> None:
    with impostor(silent_after_s=0.2) as other:
        assert other.is_sure_while(other.send)
        other.is_sure_while(lambda _: other.send(149))  # with new stamps
        assert "frame 149 comes again" in other.skin.touch.problem
        assert other.skin.frame is None
        other.send(150)
        wait_for(lambda: other.skin.touch.is_sure)
        other.send(151, age_s=0.15)  # before frame 150
        time.sleep(0.05)
        found = other.skin.touch.contacts
        assert found is None or found.sequence == 150


def test_two_drivers_of_one_name_are_never_sure_and_one_that_died_is_forgotten() -> None:
    """DDS knows of a driver that was killed for long, so that only its silence tells."""
    with impostor() as other:
        assert other.is_sure_while(other.send)
        second = other.node.create_publisher(TactileContacts, "/other/contacts", 10)
        wait_for(lambda: other.node.count_publishers("/other/contacts") == 2)
        first = other.contacts

        def both(number: int) -> None:
            other.contacts = (first, second)[number % 2]
            other.send(number)

        for _ in range(3):
            assert not other.is_sure_while(both), "for longer than one that is silent counts"
        assert other.skin.touch.problem.startswith("2 drivers publish /other/contacts: end one")
        other.contacts = first
        wait_for(lambda: other.is_sure_while(other.send))


def test_what_waited_while_the_client_slept_is_passed_over_at_once() -> None:
    """A driver in a process of its own, whose messages a client that is stopped leaves waiting."""
    felt: list[tuple[float, bool]] = []

    def feel(touch: Touch) -> None:
        if found := touch.contacts:
            age_s = node.get_clock().now().nanoseconds * 1e-9 - found.heading.stamp_ns * 1e-9
            felt.append((age_s, touch.is_sure))

    driver = [sys.executable, str(ROOT / "scripts" / "skin_driver"), "--ros-args"]
    with (
        started([*driver, "-p", "port:=sim://?scene=all&threshold=0"]),
        living(Node("slow")) as node,
    ):
        skin = SkinClient(node, on_touch=feel)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        wait_for(lambda: executor.spin_once(0.1) or skin.touch.is_sure)
        for _ in range(3):
            time.sleep(3.0)  # as after SIGSTOP, or a pause of the network
            assert not skin.touch.is_sure
            until_s = time.monotonic() + 1.0
            while time.monotonic() < until_s:
                executor.spin_once(0.1)
        executor.shutdown()
    assert len(felt) > 50
    assert max(age_s for age_s, _ in felt) < 1.0


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
        assert time.monotonic() - begun_s >= 0.35
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
