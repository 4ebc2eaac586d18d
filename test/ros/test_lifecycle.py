# SPDX-License-Identifier: Apache-2.0

"""Transitions in any order, with ports that come and go: nothing is left over."""

import gc
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import rclpy
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from lifecycle_msgs.msg import Transition, TransitionEvent
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter

from tactile_cdma.config.body_file import Patch
from tactile_cdma.driver.driver import CONNECTING
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.common import nodes
from tactile_cdma.ros.common.failures import FAILURES
from tactile_cdma.ros.driver import patches
from tactile_cdma.ros.driver.node import SkinNode
from tactile_cdma.ros.driver.patches import PatchesNode
from tactile_cdma.ros.viewers.body_view import BodyViewer
from tactile_cdma.ros.viewers.view import Viewer
from tactile_cdma.wire.port import Port
from test.support.boards import Board, plugged
from test.support.mute_host import mute_host
from test.support.skin_client import hurrying, node_with, running
from test.support.spinning import KEPT
from test.support.waiting import PATIENCE_S, wait_for

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = "unconfigured", "inactive", "active", "finalized"
TRANSITIONS = {
    (UNCONFIGURED, "configure"): INACTIVE,
    (INACTIVE, "activate"): ACTIVE,
    (ACTIVE, "deactivate"): INACTIVE,
    (INACTIVE, "cleanup"): UNCONFIGURED,
    (UNCONFIGURED, "shutdown"): FINALIZED,
    (INACTIVE, "shutdown"): FINALIZED,
    (ACTIVE, "shutdown"): FINALIZED,
}


def full_name(state: str, name: str) -> str:
    """There is a way to shut down from every state."""
    origin = UNCONFIGURED if state == FINALIZED else state
    return f"{origin}_shutdown" if name == "shutdown" else name


def readers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("skin ")]


def open_ports() -> int:
    """How often this process has the device of some pty open."""
    links = []
    for number in os.listdir("/proc/self/fd"):
        try:
            links.append(os.readlink(f"/proc/self/fd/{number}"))
        except FileNotFoundError:  # that of the listing
            continue
    return sum(link.startswith("/dev/pts/") and "ptmx" not in link for link in links)


class Lifecycle(RuleBasedStateMachine):
    """A driver node, what its state ought to be, and a port that is there, held, or not."""

    def __init__(self) -> None:
        super().__init__()
        self.exit, self.driver, self.plug = ExitStack(), ExitStack(), ExitStack()
        self.held: Port | None = None
        folder = Path(self.exit.enter_context(tempfile.TemporaryDirectory()))
        self.path = folder / "skin"
        self.others = open_ports()
        self.is_plugged = False
        self.plug_in()
        self.start()

    def start(self) -> None:
        self.state, self.nodes = UNCONFIGURED, 16
        self.node, self.client = self.driver.enter_context(
            running(autostart=False, port=str(self.path), parent_frame="palm")
        )

    @rule(name=st.sampled_from(sorted({name for _, name in TRANSITIONS})))
    def change(self, name: str) -> None:
        expected = TRANSITIONS.get((self.state, name))
        if name == "configure" and (not self.is_plugged or self.held):
            expected = None
        assert self.client.change(full_name(self.state, name)) == (expected is not None)
        self.state = expected or self.state

    @rule()
    def cycle(self) -> None:
        """The way that a user goes."""
        for name in ("configure", "activate", "deactivate", "activate"):
            self.change(name)

    @precondition(lambda self: self.state == FINALIZED)
    @rule()
    def renew(self) -> None:
        self.driver.close()
        self.start()

    @precondition(lambda self: self.is_plugged)
    @rule()
    def unplug(self) -> None:
        self.release()
        self.plug.close()
        self.is_plugged = False

    @precondition(lambda self: not self.is_plugged)
    @rule()
    def plug_in(self) -> None:
        self.plug = ExitStack()
        self.plug.enter_context(plugged(Board, self.path))
        self.is_plugged = True

    @precondition(lambda self: self.is_plugged and not self.held and self.state == UNCONFIGURED)
    @rule()
    def hold(self) -> None:
        """Another program opens the port."""
        self.held = Port(str(self.path), 115_200)

    @precondition(lambda self: self.held)
    @rule()
    def release(self) -> None:
        if self.held:
            self.held.close()
            self.held = None

    @rule(nodes=st.sampled_from([12, 16]), active_share=st.floats(0.2, 0.8))
    def set_parameters(self, nodes: int, active_share: float) -> None:
        assert self.client.set(active_share=active_share) == (True, "")
        configured = self.state in (INACTIVE, ACTIVE)
        taken, _ = self.client.set(nodes=nodes)
        assert taken == (not configured or nodes == self.nodes)
        self.nodes = nodes if taken else self.nodes

    @precondition(lambda self: self.state == ACTIVE and self.is_plugged and self.nodes == 16)
    @rule()
    def receive(self) -> None:
        before = len(self.client.arrays)
        wait_for(lambda: len(self.client.arrays) > before)

    @invariant()
    def nothing_is_left_behind(self) -> None:
        assert self.node._state_machine.current_state[1] == self.state
        assert len(readers()) == (self.state == ACTIVE)
        if self.state in (UNCONFIGURED, FINALIZED):
            theirs = self.is_plugged + (self.held is not None)  # the pty's own, another program's
            assert open_ports() == self.others + theirs

    def teardown(self) -> None:
        self.release()
        self.driver.close()  # in whatever state it is
        self.exit.close()
        assert readers() == []
        self.plug.close()
        assert open_ports() == self.others


TestLifecycle = Lifecycle.TestCase
TestLifecycle.settings = settings(
    max_examples=5,
    stateful_step_count=25,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)


class Defective(SkinNode):
    """Has defects: each of these methods raises so many times."""

    defects: dict[str, int] = {"_publish_info": 10**9}  # noqa: RUF012

    def __getattribute__(self, name: str) -> Any:
        defects = object.__getattribute__(self, "defects")
        if defects.get(name):
            defects[name] -= 1
            raise ZeroDivisionError
        return super().__getattribute__(name)


def test_a_defect_is_told_of_releases_everything_and_can_be_outlived(tmp_path: Path) -> None:
    path = tmp_path / "skin"
    others, before = open_ports(), FAILURES.count
    with plugged(Board, path), hurrying(Defective, port=str(path)) as (node, client):
        wait_for(lambda: client.says("internal error"))
        wait_for(lambda: readers() == [] and open_ports() == others + 1)
        assert FAILURES.count > before
        node.defects.clear()
        wait_for(lambda: client.arrays)  # it is tried again


@pytest.mark.parametrize(
    "defects, transition, ends",
    [
        ({"_rest_path": 1}, "configure", UNCONFIGURED),
        ({"_stop_driver": 1}, "deactivate", UNCONFIGURED),
        ({"release": 1}, "shutdown", UNCONFIGURED),
        ({"release": 2}, "shutdown", FINALIZED),
    ],
)
def test_a_defect_in_a_transition_ends_no_node(
    defects: dict[str, int], transition: str, ends: str
) -> None:
    Defective.defects = {}
    with running(Defective, autostart=False, port="sim://") as (node, client):
        state = UNCONFIGURED
        if transition != "configure":
            assert client.change("configure", "activate")
            state = ACTIVE
        before, node.defects = FAILURES.count, dict(defects)
        assert not client.change(full_name(state, transition))
        assert client.state() == ends
        assert FAILURES.count == before + (1 + (ends == FINALIZED))
        if ends != FINALIZED:
            assert client.change("configure", "activate")
            wait_for(lambda: client.arrays)


def test_a_manager_learns_why_a_node_cannot_start_and_then_starts_and_ends_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """As nav2's does: transitions by their number, and after each a look at the state."""
    with running(autostart=False, port=str(tmp_path / "none")) as (_, client):
        for _ in range(2):
            assert not client.change("configure")
        assert not client.change("activate")
        said = capfd.readouterr().err
        assert said.count("cannot configure: ") == said.count("/none: no such port") == 2
        assert (
            f"transition {Transition.TRANSITION_ACTIVATE} is not possible: the node is un" in said
        )
        assert client.set(port="sim://") == (True, "")
        state = UNCONFIGURED
        life = ("configure", "activate", "deactivate", "cleanup")
        for name in (*life, *life, "shutdown"):
            assert client.change(full_name(state, name))
            state = TRANSITIONS[state, name]
            assert client.state() == state


def test_a_destroyed_node_leaves_no_services_behind() -> None:
    gc.disable()  # which would find them some time
    watcher = rclpy.create_node("watcher")

    def services() -> set[str]:
        return {name for name, _ in watcher.get_service_names_and_types()}

    try:
        with running(autostart=False):
            wait_for(lambda: "/skin/change_state" in services())
        wait_for(lambda: not services() & {"/skin/change_state", "/skin/get_state", "/skin/tare"})
    finally:
        watcher.destroy_node()
        gc.enable()


class Unstarted(SkinNode):
    """Raises when all of it is there, and streams."""

    def _start(self) -> None:
        super()._start()
        raise ArithmeticError


@pytest.mark.parametrize(
    "make",
    [
        Unstarted,
        lambda: SkinNode(parameter_overrides=[Parameter("port")]),
        BodyNode,
        lambda: node_with(BodyNode, start_type_description_service="what rclpy looks at last"),
        lambda: PatchesNode([Patch("palm", None, {}, {})]),
        lambda: Viewer("a b/tactile"),
        lambda: BodyViewer("a b"),
    ],
)
def test_a_node_whose_constructor_raises_leaves_nothing_behind(
    make: Callable[[], rclpy.node.Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the exception is kept, whose traceback refers to the node."""
    monkeypatch.setattr(patches, "LOOK_S", "no time")
    watcher, others = rclpy.create_node("watcher"), open_ports()

    def seen() -> list[str]:
        told = watcher.get_publishers_info_by_topic("/parameter_events")
        return sorted([one.node_name for one in told] + watcher.get_node_names())

    try:
        with pytest.raises(Exception) as kept:
            make()

        # The middleware tells it a little later.
        wait_for(lambda: seen() == [KEPT] * 2 + ["watcher"] * 2)
        assert readers() == [] and open_ports() == others
        assert kept.tb is not None
    finally:
        watcher.destroy_node()


def test_who_waits_for_a_transition_hears_it_though_the_node_starts_by_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As launch's OnStateTransition: the event is sent once, to whom the node knows by then.

    The listener is another process's: it has a context, so a participant, of its own.
    """
    monkeypatch.setattr(nodes, "DISCOVERY_S", PATIENCE_S)
    monkeypatch.setattr(sys, "argv", ["skin_driver", "--ros-args", "-r", "__node:=skin"])
    nodes._began_s.cache_clear()
    heard: list[str] = []
    with ExitStack() as ends, ThreadPoolExecutor(1) as pool:
        making = pool.submit(node_with, SkinNode)
        context = rclpy.Context()
        rclpy.init(context=context)
        ends.callback(context.shutdown)
        listener = rclpy.create_node("listener", context=context)
        wait_for(lambda: "skin" in listener.get_node_names())
        assert not making.done(), "it waits until somebody listens"
        listener.create_subscription(
            TransitionEvent,
            "/skin/transition_event",
            lambda m: heard.append(m.goal_state.label),
            10,
        )
        executor = SingleThreadedExecutor(context=context)
        ends.callback(executor.shutdown)
        executor.add_node(listener)

        def is_active() -> bool:
            executor.spin_once(0.1)
            return ACTIVE in heard

        wait_for(is_active)
        ends.callback(making.result().destroy_node)
    assert heard[-3:] == [INACTIVE, "activating", ACTIVE]


@pytest.mark.parametrize("words", [[], ["--ros-args", "-r", "__node:=skin"]])
def test_a_node_that_nobody_waits_for_starts_all_the_same(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, but for the first one of a process that launch has started."""
    looks = mock.Mock(return_value=0)
    monkeypatch.setattr(SkinNode, "count_subscribers", looks)
    monkeypatch.setattr(nodes, "DISCOVERY_S", 1.0)
    monkeypatch.setattr(sys, "argv", ["skin_driver", *words])
    nodes._began_s.cache_clear()
    node_with(SkinNode).destroy_node()
    assert (looks.call_count > 1) == bool(words)
    wait_for(lambda: time.monotonic() > nodes._began_s() + nodes.DISCOVERY_S)
    looks.reset_mock()
    node_with(SkinNode).destroy_node()
    assert not looks.called


def test_transitions_work_by_call_too_and_a_node_may_go_in_any_state() -> None:
    for steps in (
        [],
        ["configure"],
        ["configure", "activate"],
        ["configure", "activate", "deactivate"],
        ["configure", "activate", "shutdown"],
    ):
        node = node_with(SkinNode, autostart=False)
        for step in steps:
            assert getattr(node, f"trigger_{step}")() == TransitionCallbackReturn.SUCCESS
        impossible = "cleanup" if steps[-1:] == ["activate"] else "deactivate"
        with suppress(RCLError):  # Jazzy raises, Kilted answers
            assert getattr(node, f"trigger_{impossible}")() != TransitionCallbackReturn.SUCCESS
        node.destroy_node()
        assert readers() == []


def test_a_host_that_does_not_answer_holds_up_nothing() -> None:
    """An attempt to connect lasts 5 s; no transition waits for it."""
    down, up = ("deactivate", "cleanup"), ("configure", "activate")
    with mute_host() as url, hurrying(port=url) as (_, client):
        wait_for(lambda: client.diagnostics[-1].message == CONNECTING)
        for names in (down, up, down):
            attempts = [each for each in threading.enumerate() if each.name == f"skin {url}"]
            assert client.change(*names)
            assert all(each.is_alive() for each in attempts), "waited for an attempt to connect"
        assert client.set(port="socket://") == (True, "")
        assert not client.change("configure")
        wait_for(lambda: "host and port" in client.diagnostics[-1].message)
