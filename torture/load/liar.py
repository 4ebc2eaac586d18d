# SPDX-License-Identifier: Apache-2.0

"""A program on the network that lies: to every node and example, in messages and in requests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from random import Random
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point32, TransformStamped, Vector3
from rclpy._rclpy_pybind11 import RCLError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, PointCloud2
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from tactile_cdma.msg import (
    SimObject,
    SimObjects,
    TactileArray,
    TactileContact,
    TactileContacts,
    TactileSkinInfo,
)
from test.support.domains import own_domain
from test.support.spinning import spinning

from ..fuzz.target import mutated
from ..outcome import Outcome, Plan
from .hostile import lie, of_now

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60.0
"""Time without an answer, or the end, that counts as a hang, s."""
PERIOD_S = 5e-3
"""Between two lies, s."""
AT_ONCE = 8
"""Requests under way at the same time: services keep 10."""
TAXELS = 16
_HEADER = Header(frame_id="skin")
TRUTH: dict[str, Any] = {
    "/skin/tactile": TactileArray(
        header=_HEADER, height=4, width=4, pressure=array("f", range(16)), status=bytes(16)
    ),
    "/skin/info": TactileSkinInfo(
        header=_HEADER,
        height=4,
        width=4,
        positions=[Point32(x=0.01 * (i % 4), y=0.01 * (i // 4)) for i in range(TAXELS)],
        normals=[Point32(z=1.0)] * TAXELS,
        area=[1e-4] * TAXELS,
        node=range(1, TAXELS + 1),
    ),
    "/skin/contacts": TactileContacts(
        header=_HEADER,
        contacts=[TactileContact(patch="/skin", force=Vector3(z=-1.0), taxels=[1])],
        touched=True,
        taxels_in_service=TAXELS,
        taxels_valid=TAXELS,
    ),
    "/skin/points": PointCloud2(header=_HEADER, data=bytes(36), point_step=36),
    "/body/contacts": TactileContacts(header=_HEADER, absent=["/skin"]),
    "/diagnostics": DiagnosticArray(status=[DiagnosticStatus(name="skin: stream", level=b"\2")]),
    "/tf": TFMessage(transforms=[TransformStamped(header=_HEADER, child_frame_id="palm")]),
    "/clock": Clock(),
    "/joint_states": JointState(header=_HEADER, name=["a"], position=[1.0]),
    "/pressed/skin/sim/objects": SimObjects(
        objects=[SimObject(shape=SimObject.SPHERE, size=[0.01])]
    ),
}
"""What a skin, its body and a robot might say, by topic."""
SERVED = ("/pressed/skin", "/body")
"""Nodes whose services are called."""
NEVER = ("change_state",)
"""Services that do what they are asked for, whatever that is: they may end the node's life."""


def commands(folder: Path) -> dict[str, list[str]]:
    """The programs that are lied to: the nodes, and the examples that subscribe."""
    state = ["-p", f"state_folder:={folder / 'state'}", "-p", "use_sim_time:=true"]
    pressed = ["-p", "port:=sim://?scene=external", "-r", "__ns:=/pressed", *state]
    found = {
        "skin_driver": [str(ROOT / "scripts/skin_driver"), "--ros-args", *pressed],
        "skin_body": [str(ROOT / "scripts/skin_body"), "--ros-args", "-p", "patches:=['/skin']"],
        "skin_view": [str(ROOT / "scripts/skin_view"), "--seconds", "3600"],
        "skin_body_view": [str(ROOT / "scripts/skin_body_view"), "--seconds", "3600"],
    }
    for example in ("subscribe", "taxel_map", "points_to_numpy", "grip", "fuse_joint_states"):
        found[example] = [str(ROOT / f"examples/{example}.py")]
    return found


def lied_to(plan: Plan, folder: Path) -> Outcome:
    """Have nodes and examples hear some truth and many lies; all of them must live and end."""
    domain = own_domain()
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_HOME": str(folder / "ros")}
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    dead: list[str] = []
    hung: list[str] = []
    with ExitStack() as stack:
        processes = {}
        for name, command in commands(folder).items():
            log = stack.enter_context((folder / f"{name}.log").open("wb"))
            processes[name] = subprocess.Popen(
                [sys.executable, *command], env=environment, stdout=log, stderr=log
            )
            stack.callback(processes[name].kill)
        node = stack.enter_context(_liar(domain))
        told = _lies(node, Random(plan.seed), 400 if plan.quick else 20_000)
        asked, unanswered = _requests(node, Random(plan.seed), 5 if plan.quick else 200)
        hung += unanswered
        for name, process in processes.items():
            if process.poll() is not None:
                dead.append(name)
            process.send_signal(signal.SIGTERM if "skin" in name else signal.SIGINT)
        for name, process in processes.items():
            try:
                if process.wait(PATIENCE_S) < 0 and name not in dead:
                    dead.append(f"{name} (signal {-process.returncode})")
            except subprocess.TimeoutExpired:
                hung.append(name)
    said = ", ".join([*(f"{name} ended" for name in dead), *(f"{name} hung" for name in hung)])
    return Outcome(
        f"lies to {len(processes)} nodes and examples, raw and typed, in messages and requests",
        told + asked,
        crashes=len(dead),
        hangs=len(hung),
        said=said or f"{told} messages, {asked} requests",
    )


@contextmanager
def _liar(domain: int) -> Iterator[Node]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("liar", context=context)
    try:
        with spinning([node]):
            yield node
    finally:
        rclpy.shutdown(context=context)


def _lies(node: Node, rng: Random, times: int) -> int:
    """Publish the truth until everybody listens, then that many lies; returns how many."""
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publishers = {
        topic: node.create_publisher(type(message), topic, latched if "info" in topic else 10)
        for topic, message in TRUTH.items()
    }
    _wait(lambda: all(node.count_subscribers(topic) for topic in TRUTH))
    for number in range(times):
        topic = rng.choice(list(TRUTH))
        truth = of_now(TRUTH[topic])
        message = of_now(lie(truth, rng)) if rng.random() < 0.7 else truth
        if number % 2:
            publishers[topic].publish(message)
        else:
            with suppress(RCLError):  # too large, or not even a header: it is not sent
                raw = [serialize_message(each) for each in (truth, message)]
                publishers[topic].publish(mutated(rng, raw))
        time.sleep(PERIOD_S)
    return times


def _requests(node: Node, rng: Random, times: int) -> tuple[int, list[str]]:
    """Call every service that many times AT_ONCE; returns the calls, and what was not answered."""
    asked, unanswered = 0, []
    for served in SERVED:
        namespace, _, name = served.rpartition("/")
        services = node.get_service_names_and_types_by_node(name, namespace or "/")
        for service, [kind, *_] in services:
            if service.rpartition("/")[2] in NEVER:
                continue
            package, _, type_name = kind.split("/")
            service_type = getattr(import_module(f"{package}.srv"), type_name)
            client = node.create_client(service_type, service)
            for _ in range(times):
                requests = [lie(service_type.Request(), rng) for _ in range(AT_ONCE)]
                for request in requests:
                    if getattr(request, "wait", 0.0) > 1.0:  # a tare would, for ten minutes
                        request.wait = 1.0
                calls = [client.call_async(request) for request in requests]
                asked += len(calls)
                if not _wait(partial(are_done, calls)):
                    unanswered.append(service)
                    break
    return asked, unanswered


def are_done(calls: Sequence[Future[Any]]) -> bool:
    """Whether all of them were answered."""
    return all(call.done() for call in calls)


def _wait(condition: Callable[[], object]) -> bool:
    """Whether it came to hold within PATIENCE_S."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.05)
    return True
