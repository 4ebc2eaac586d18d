# SPDX-License-Identifier: Apache-2.0

"""Two patches on a robot, in one frame: how hard each is pressed, and by how much they differ.

Each patch has a driver of its own; the body's node puts their contacts into the robot's frame. A
patch that is absent is unknown, not untouched; so is one that is none of the body's, such as a
misspelt one. Which ones are is in the body's diagnostics, once a second.

    make run PATCHES=config/body.yaml               # drivers and the body's node
    .venv/bin/python examples/two_patches.py        # the forearms of that body
    .venv/bin/python examples/two_patches.py /left_palm/skin /chest/skin

It prints the force (N) on each patch and the sum, in the body's frame, twice a second.
"""

import sys
from contextlib import suppress

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from tactile_cdma.msg import TactileContacts

FOREARMS = ["/left_forearm/skin", "/right_forearm/skin"]


class TwoPatches(Node):
    def __init__(self, patches: list[str]) -> None:
        super().__init__("two_patches")
        self.patches, self.latest = patches, None
        self.of_body: set[str] = set()
        self.create_subscription(TactileContacts, "/body/contacts", self.take, 10)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.learn, 10)
        self.create_timer(0.5, self.show)

    def take(self, message: TactileContacts) -> None:
        self.latest = message

    def learn(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "body: patches":
                self.of_body = {patch.key for patch in status.values}

    def show(self) -> None:
        message, self.latest = self.latest, None
        if message is None:
            print("no body", flush=True)
            return
        total_n = np.zeros(3)
        for patch in self.patches:
            forces = [c.force for c in message.contacts if c.patch == patch]
            force_n = np.array([(f.x, f.y, f.z) for f in forces]).reshape(-1, 3).sum(axis=0)
            if patch in message.absent or patch not in self.of_body:
                force_n[:] = np.nan  # nothing is known of it
            total_n += force_n
            print(patch, *np.round(force_n, 2), end="  ")
        print("sum", *np.round(total_n, 2), flush=True)


rclpy.init()
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(TwoPatches(remove_ros_args(sys.argv)[1:] or FOREARMS))
