# SPDX-License-Identifier: Apache-2.0

"""~/sim/objects: what other programs press on a simulated skin."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from rclpy.lifecycle import LifecycleNode
from rclpy.subscription import Subscription

from tactile_cdma.msg import SimObject, SimObjects

from ...base.errors import ParameterError, TactileError
from ...config.parameters import Values
from ...config.python_arguments import instance
from ...driver.driver import Driver
from ...sim import Box, Capsule, Cylinder, Ellipsoid, Indenter, Sphere
from ...sim.indenters import STIFFNESS_PA_PER_M
from ...sim.pressing import is_pressable, press
from ...wire.port import Port
from ..common.qos import RELIABLE

TOPIC = "~/sim/objects"
_EDGES = "x", "y", "z"
_SHAPES: dict[int, tuple[str, Any, tuple[str, ...]]] = {
    SimObject.SPHERE: ("a sphere", Sphere, ("radius",)),
    SimObject.CYLINDER: ("a cylinder", Cylinder, ("radius", "length")),
    SimObject.BOX: ("a box", Box, _EDGES),
    SimObject.CAPSULE: ("a capsule", Capsule, ("radius", "length")),
    SimObject.ELLIPSOID: ("an ellipsoid", Ellipsoid, _EDGES),
}
"""Name, class, and numbers of the size of each shape."""


class ObjectsInput:
    """Hands what is published on ~/sim/objects to the driver, while there is one."""

    def __init__(self, node: LifecycleNode, live: Values) -> None:
        self._node, self._live = node, live
        self._subscription: Subscription | None = None
        self._pressable, self._frames = False, 0

    def configure(self, port: Port | None) -> None:
        """Note what the port is: a skin that nobody can press has no such topic."""
        self._pressable = port is not None and is_pressable(port)
        self._frames = int(port is not None and port.stepped)

    def start(self, driver: Driver) -> None:
        if self._pressable:
            take = partial(self._press, driver)
            self._subscription = self._node.create_subscription(SimObjects, TOPIC, take, RELIABLE)

    def stop(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _press(self, driver: Driver, message: SimObjects) -> None:
        frame_id = str(self._live["frame_id"])
        try:
            if message.header.frame_id not in ("", frame_id):
                raise ParameterError(
                    f"frame_id is {message.header.frame_id!r}; poses must be in the frame of "
                    f"the skin, {frame_id!r}"
                )
            press(driver, [indenter(each) for each in message.objects], self._frames)
        except TactileError as error:
            log = self._node.get_logger()
            log.error(f"{TOPIC}: not pressed: {error}", throttle_duration_sec=1.0)


def indenter(message: SimObject) -> Indenter:
    """Return an object of a message; raises ParameterError for one that cannot be."""
    if message.shape not in _SHAPES:
        raise ParameterError(f"shape is {message.shape}; SimObject has {sorted(_SHAPES)}")
    what, kind, names = _SHAPES[message.shape]
    size = [float(edge) for edge in message.size]
    if len(size) != len(names):
        raise ParameterError(f"{what} has the size ({', '.join(names)}), not {len(size)} values")
    where, turned = message.pose.position, message.pose.orientation
    lengths_m = {f"{name}_m": length_m for name, length_m in zip(names, size, strict=True)}
    made: Indenter = kind(
        **({"size_m": size} if names == _EDGES else lengths_m),
        position_m=(where.x, where.y, where.z),
        orientation_xyzw=(turned.x, turned.y, turned.z, turned.w),
        stiffness_pa_per_m=message.stiffness or STIFFNESS_PA_PER_M,
    )
    return made


def sim_objects(objects: Sequence[Indenter]) -> SimObjects:
    """Return the message of these objects."""
    return SimObjects(objects=[_message(each) for each in objects])


def _message(thing: Indenter) -> SimObject:
    stiffness = float(instance("an object", thing, Indenter).stiffness_pa_per_m)
    message = SimObject(stiffness=stiffness)
    where, turned = message.pose.position, message.pose.orientation
    where.x, where.y, where.z = map(float, thing.position_m)
    turned.x, turned.y, turned.z, turned.w = map(float, thing.orientation_xyzw)
    for shape, (_, kind, names) in _SHAPES.items():
        if isinstance(thing, kind):
            fields = ["size_m"] if names == _EDGES else [f"{name}_m" for name in names]
            size = np.hstack([getattr(thing, field) for field in fields])
            message.shape, message.size = shape, size.astype(float).tolist()
            return message
    raise ParameterError(f"SimObject has no shape for a {type(thing).__name__}")
