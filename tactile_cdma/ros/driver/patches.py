# SPDX-License-Identifier: Apache-2.0

"""The drivers of many patches in one process: `skin_patches body.yaml --only left_palm`."""

import argparse
import sys
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.parameter import Parameter

from ...base.program import program
from ...base.text import plain
from ...config.body_file import Patch, read_body
from ...config.skin_config import user_path
from ..common.convert import diagnostic, report
from ..common.failures import FAILURES
from ..common.nodes import STEADY, all_or_nothing
from ..common.process import own_words, run_node
from .node import SkinNode
from .pictures import LOOK_S, Pictures

RETRY_S, NEXT_S = 2.0, 0.02
"""Time between attempts to make a node, s; chosen as between those to start it. Time left to those
that are made before the next one is, which takes 0.1 s or more, s; chosen."""

NAMESPACE = "__ns:="
"""What a ROS argument begins with that gives a process's nodes a namespace, after -r."""


class PatchesNode(Node):
    """Has a SkinNode for every patch, served by the executor that serves this one.

    A node that cannot be made, because of its parameters, say, takes no other with it: /diagnostics
    and the log say why, and it is tried again with its parameter file as it is then.
    """

    @all_or_nothing
    def __init__(self, patches: Sequence[Patch]) -> None:
        self._nodes: list[SkinNode] = []  # first, as destroy_node ends them
        super().__init__("patches", namespace=patches[0].namespace)
        self._untried, self._failed = deque(patches), list[Patch]()
        self._faults: dict[str, str] = {}  # by node
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._next = self.create_timer(NEXT_S, self._make_next, clock=STEADY)
        self._retry = self.create_timer(RETRY_S, self._try_again, clock=STEADY)
        # One for all: every timer that comes has the executor look at all that all nodes have.
        self.create_timer(LOOK_S, self._look, clock=STEADY)

    def destroy_node(self) -> None:
        """End the patches' nodes, too.

        All drivers first: DDS takes minutes to forget the topics of a hundred patches, and what
        started this process may kill it meanwhile.
        """
        for end in (SkinNode.release, SkinNode.destroy_node):
            for node in self._nodes:
                FAILURES.survive(end, node)
        super().destroy_node()

    def _make_next(self) -> None:
        if not self._untried:
            self._next.cancel()
            return
        patch = self._untried.popleft()
        try:
            node = made(patch)
        except Exception as error:  # whatever it is, it is this patch's
            self._failed.append(patch)
            name, fault = patch.node, plain(str(error)) or type(error).__name__
            if self._faults.get(name) != fault:
                self._faults[name] = fault
                self.get_logger().error(f"{name} cannot run: {fault}")
            entry = diagnostic(f"{name.lstrip('/')}: process", DiagnosticStatus.ERROR, fault, {})
            self._diagnostics.publish(report(self, [entry]))
        else:
            node.look_timer.cancel()
            self._nodes.append(node)
            assert self.executor is not None
            self.executor.add_node(node)
        self._next.reset()  # the callbacks of those that are made come first

    def _try_again(self) -> None:
        self._untried.extend(self._failed)
        self._failed.clear()
        if self._untried:
            self._next.reset()
        else:
            self._retry.cancel()

    def _look(self) -> None:
        for node in self._nodes:
            FAILURES.survive(Pictures.look, node.pictures)


def made(patch: Patch) -> SkinNode:
    """Return the driver node of a patch; raises what rcl, or the node, does not take."""
    overrides: list[Any] = [
        Parameter(name, value=list(value) if isinstance(value, tuple) else value)
        for name, value in patch.parameters.items()
    ]
    file = ["--ros-args", "--params-file", str(patch.params_file)] if patch.params_file else None
    return SkinNode(namespace=patch.namespace, parameter_overrides=overrides, cli_args=file)


@program("skin_patches")
def main() -> int:
    """Run the nodes until interrupted; returns the exit code."""
    parser = argparse.ArgumentParser(prog="skin_patches", description=__doc__, allow_abbrev=False)
    parser.add_argument("body_file")
    parser.add_argument("--only", default="", metavar="NAMES", help="left_palm,left_arm; all")
    arguments = parser.parse_args(own_words())
    # What is given to all nodes of a process, rcl would put in place of their own.
    given = [word for word in sys.argv if word.startswith(NAMESPACE)]
    for word in given:
        at = sys.argv.index(word)
        del sys.argv[at - 1 : at + 1]  # with the -r before it
    namespace = given[-1].removeprefix(NAMESPACE) if given else ""
    path = user_path("body_file", arguments.body_file)
    patches = read_body(path, namespace).only(arguments.only)
    return run_node(partial(PatchesNode, patches))


if __name__ == "__main__":
    sys.exit(main())
