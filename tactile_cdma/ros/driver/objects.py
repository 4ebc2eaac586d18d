# SPDX-License-Identifier: Apache-2.0

"""~/sim/objects: what other programs press on a simulated skin."""

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.subscription import Subscription

from tactile_cdma.msg import SimObject, SimObjects

from ...base.errors import ParameterError, TactileError
from ...config.parameters import Values
from ...config.python_arguments import instance
from ...driver.driver import Driver
from ...sim.indenters import (
    STIFFNESS_PA_PER_M,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Indenter,
    Sphere,
)
from ...sim.pressing import is_pressable, press
from ...wire.port import Port
from ..common.qos import RELIABLE

TOPIC = "~/sim/objects"
_SIZES = {
    SimObject.SPHERE: ("a sphere", ("radius",)),
    SimObject.CYLINDER: ("a cylinder", ("radius", "length")),
    SimObject.BOX: ("a box", ("x", "y", "z")),
    SimObject.CAPSULE: ("a capsule", ("radius", "length")),
    SimObject.ELLIPSOID: ("an ellipsoid", ("x", "y", "z")),
}


class ObjectsInput:
    """Hands what is published on ~/sim/objects to the driver, while there is one."""

    def __init__(self, node: LifecycleNode, live: Values) -> None:
        """live: the parameters' present values, kept by the node."""
        self._node, self._live = node, live
        self._subscription: Subscription | None = None
        self._pressable, self._frames = False, 0

    def configure(self, port: Port | None) -> None:
        """Note what the port is: a skin that nobody can press has no such topic."""
        self._pressable = port is not None and is_pressable(port)
        self._frames = int(port is not None and port.stepped)

    def start(self, driver: Driver) -> None:
        """Subscribe."""
        if self._pressable:
            take = self._press_by(driver)
            self._subscription = self._node.create_subscription(SimObjects, TOPIC, take, RELIABLE)

    def stop(self) -> None:
        """Unsubscribe."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _press_by(self, driver: Driver) -> Callable[[SimObjects], None]:
        def take(message: SimObjects) -> None:
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

        return take


def indenter(message: SimObject) -> Indenter:
    """An object of a message; raises ParameterError for one that cannot be."""
    what, names = _SIZES.get(message.shape, ("", ()))
    if not what:
        raise ParameterError(f"shape is {message.shape}; SimObject has {sorted(_SIZES)}")
    size = [float(edge) for edge in message.size]
    if len(size) != len(names):
        raise ParameterError(f"{what} has the size ({', '.join(names)}), not {len(size)} values")
    where, turned = message.pose.position, message.pose.orientation
    common: dict[str, Any] = {
        "position_m": (where.x, where.y, where.z),
        "orientation_xyzw": (turned.x, turned.y, turned.z, turned.w),
        "stiffness_pa_per_m": message.stiffness or STIFFNESS_PA_PER_M,
    }
    if message.shape == SimObject.SPHERE:
        return Sphere(radius_m=size[0], **common)
    if message.shape in (SimObject.CYLINDER, SimObject.CAPSULE):
        kind = Cylinder if message.shape == SimObject.CYLINDER else Capsule
        return kind(radius_m=size[0], length_m=size[1], **common)
    return (Box if message.shape == SimObject.BOX else Ellipsoid)(size_m=size, **common)


def sim_objects(objects: Sequence[Indenter]) -> SimObjects:
    """The message of these objects."""
    return SimObjects(objects=[_message(each) for each in objects])


def _message(thing: Indenter) -> SimObject:
    stiffness = float(instance("an object", thing, Indenter).stiffness_pa_per_m)
    message = SimObject(stiffness=stiffness)
    where, turned = message.pose.position, message.pose.orientation
    where.x, where.y, where.z = map(float, thing.position_m)
    turned.x, turned.y, turned.z, turned.w = map(float, thing.orientation_xyzw)
    match thing:
        case Sphere():
            message.shape, message.size = SimObject.SPHERE, [float(thing.radius_m)]
        case Cylinder() | Capsule():
            kind = SimObject.CYLINDER if isinstance(thing, Cylinder) else SimObject.CAPSULE
            message.shape, message.size = kind, [float(thing.radius_m), float(thing.length_m)]
        case Box() | Ellipsoid():
            kind = SimObject.BOX if isinstance(thing, Box) else SimObject.ELLIPSOID
            message.shape, message.size = kind, [float(edge) for edge in thing.size_m]
        case _:
            raise ParameterError(f"SimObject has no shape for a {type(thing).__name__}")
    return message
