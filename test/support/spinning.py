# SPDX-License-Identifier: Apache-2.0

"""ROS nodes that are served in the background."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import TypeVar

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from tactile_cdma.ros.common.executor import LeanExecutor

N = TypeVar("N", bound=Node)
KEPT = "_participant"
"""The hidden node of a module's tests."""


@contextmanager
def initialised() -> Iterator[None]:
    """Initialise rclpy, with a hidden node that keeps the DDS participant as others come and go.

    Fast DDS 2.14 may hang or crash where it ends a participant that is told of others' topics.
    """
    rclpy.init()
    kept = rclpy.create_node(KEPT, enable_rosout=False, start_parameter_services=False)
    try:
        yield
    finally:
        kept.destroy_node()
        rclpy.shutdown()


@contextmanager
def living(node: N) -> Iterator[N]:
    """A node that nobody serves, or the test itself."""
    try:
        yield node
    finally:
        node.destroy_node()


@contextmanager
def spinning(*groups: Sequence[Node]) -> Iterator[None]:
    """Nodes served in the background, each group by an executor in a thread of its own; then ended.

    Executors are shut down when they spin no more: rclpy would trip over what is gone.
    """
    ended = threading.Event()
    executors = []
    for nodes in groups:
        executors.append(SingleThreadedExecutor(context=nodes[0].context))
        for node in nodes:
            executors[-1].add_node(node)

    def spin(executor: SingleThreadedExecutor) -> None:
        while not ended.is_set():
            executor.spin_once()

    threads = [threading.Thread(target=spin, args=(executor,)) for executor in executors]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for executor, thread in zip(executors, threads, strict=True):
            executor.create_task(lambda: None)  # rclpy's wait ends only with something to do
            thread.join()
            executor.shutdown()
        for node in chain(*groups):
            node.destroy_node()


@contextmanager
def as_its_process(node: Node) -> Iterator[threading.Thread]:
    """A node that is spun as its own program does it, in a thread that what it raises ends."""
    executor, ended = LeanExecutor(), threading.Event()
    executor.add_node(node)

    def spin() -> None:
        while not ended.is_set():
            executor.spin_once(0.05)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield thread
    finally:
        ended.set()
        thread.join()
        executor.shutdown()
        node.destroy_node()
