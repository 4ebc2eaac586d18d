# SPDX-License-Identifier: Apache-2.0

"""Requests and messages that are well-formed and impossible: refused, counted, and survived."""

import pytest
from builtin_interfaces.msg import Time
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from tactile_cdma.rest.rest_keeper import RestKeeper
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.common.failures import FAILURES
from tactile_cdma.ros.driver.node import SkinNode
from test.support.skin_client import Client, node_with, wait_sending
from test.support.spinning import as_its_process, spinning
from test.support.waiting import wait_for

NODES = {
    "/skin": lambda: node_with(SkinNode, port="sim://?scene=idle", state_folder="/nowhere"),
    "/body": lambda: node_with(BodyNode, patches=["/skin"]),
}


@pytest.mark.parametrize("name", NODES)
def test_impossible_requests_are_answered_and_the_node_goes_on(name: str) -> None:
    client = Client(name)
    with spinning([client]), as_its_process(NODES[name]()) as process:
        for kind in (10, 99, 255):
            unknown = Parameter(name="frame_id", value=ParameterValue(type=kind))
            before = FAILURES.count
            for service in (SetParameters, SetParametersAtomically):
                topic = "set_parameters" + "_atomically" * (service is SetParametersAtomically)
                answer = client.call(service, topic, service.Request(parameters=[unknown]))
                assert "successful=True" not in repr(answer)
            assert FAILURES.count == before + 2
        assert client.set(use_sim_time=True) == (True, "")
        clock = client.create_publisher(Clock, "/clock", 1)
        before = FAILURES.count
        wait_sending([(clock, Clock(clock=Time(sec=-5)))], lambda: FAILURES.count > before)
        wait_for(lambda: int(client.value("host", "failed callbacks") or 0) > before)
        assert process.is_alive()


def test_state_is_saved_before_anything_of_ros_is_destroyed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Destroying may crash: rclpy did so once, after the process of a subscriber was killed."""
    ended: list[type] = []
    for kind, method in ((RestKeeper, "deactivate"), (Node, "destroy_node")):
        original = getattr(kind, method)
        spy = lambda self, kind=kind, end=original: (ended.append(kind), end(self))  # noqa: E731
        monkeypatch.setattr(kind, method, spy)
    with as_its_process(NODES["/skin"]()):
        pass
    assert ended == [RestKeeper, Node]
