# SPDX-License-Identifier: Apache-2.0

"""A skin for programs of rclpy: what it feels, whether that can be relied on, and its services."""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from numpy.typing import NDArray
from rclpy._rclpy_pybind11 import InvalidHandle
from rclpy.client import Client
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from rclpy.validate_topic_name import validate_topic_name

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo
from tactile_cdma.srv import Tare

from ..base.arrays import Bools, Floats, Floats32
from ..base.errors import MessageError, ParameterError, PortError
from ..config.python_arguments import argument, forced, instance, seconds
from ..readings.baseline import ALL
from ..readings.status import is_certain
from .common.convert import nanoseconds, places_of, readings_of
from .common.newest import Newest, Rivals
from .common.nodes import STEADY
from .common.qos import FRESH, LATCHED
from .common.touches import STATE, Touches

SILENT_S = 0.5
"""A skin that has sent nothing of now for longer, s, is not felt any more; chosen for control."""
LONGEST_S = 86_400.0
"""Longest time that a program can ask for, s; chosen: a day."""
ANSWER_S = 5.0
"""Longest wait for a service, s, besides what was asked of it; chosen: discovery takes a second."""
SETTLED_S = 0.3
"""A contact's speed counts from this age on, s: until then it is still spreading; chosen."""
_NO_STATES = np.zeros(0, dtype=STATE)
TRANSITIONS = {
    name: int(getattr(Transition, f"TRANSITION_{name.upper()}"))
    for name in ("configure", "activate", "deactivate", "cleanup")
}


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """Holds what a skin feels.

    problem: why nothing is to be concluded from it, in words; empty if every taxel in service has a
    certain reading, and every amount is known.
    contacts: the newest message, as arrays; None if the skin is silent.
    """

    problem: str
    contacts: Touches | None

    @property
    def is_sure(self) -> bool:
        """Tell whether touched, untouched and all amounts are to be relied on."""
        return not self.problem

    @property
    def touched(self) -> bool:
        """Tell whether there is a contact, by certain readings; also where others are blind."""
        return self.contacts is not None and self.contacts.touched

    @property
    def pressure_pa(self) -> float:
        """Return the pressure of the most loaded taxel in contact, Pa; 0 without a contact."""
        return float(self._states["pressure_max"].max(initial=0.0))

    @property
    def force_n(self) -> Floats:
        """Return (3,) resultant force on the skin, N; NaN if it is not known."""
        return np.full(3, np.nan) if self.contacts is None else self.contacts.force_n

    @property
    def speed_m_s(self) -> float:
        """Speed of the fastest contact that has settled, m/s: it slides, or rolls."""
        if self.contacts is None:
            return 0.0
        velocities = self._states["velocity"][self.contacts.ids["age"] > SETTLED_S]
        return float(np.linalg.norm(velocities, axis=1).max(initial=0.0))

    @property
    def _states(self) -> NDArray[np.void]:
        return _NO_STATES if self.contacts is None else self.contacts.states


@dataclass(frozen=True, slots=True, eq=False)
class TaxelFrame:
    """One TactileArray, with the places of its taxels.

    pressure_pa: (t,) float32, Pa, NaN without a reading. valid: (t,) bool, with a certain one.
    positions_m, normals: (t, 3) float64. areas_m2: (t,) float32. sigma_pa: (t,) float32, how sure
    pressures are, 1 σ, Pa; (0,) unless the driver's publish_sigma is set.
    """

    message: TactileArray
    pressure_pa: Floats32
    valid: Bools
    positions_m: Floats
    normals: Floats
    areas_m2: Floats32
    sigma_pa: Floats32


class SkinClient:
    """A driver's topics and services, for a node of the program's own.

        skin = SkinClient(node, "/left_palm/skin", on_touch=feel)

    on_touch: called with a Touch for every frame, and repeatedly, with a problem, while the skin is
        silent. frames: also receive the taxels, see frame.
    clocks_apart_s: how far the driver's clock may be off this computer's.
    touch, info: the newest; a touch that is too old has a problem. info: None before the first one.

    Methods that wait for an answer are for threads other than the one that spins the node: in
    callbacks use tare_async.

    ParameterError: raised for a silent_after_s or clocks_apart_s that is no time.
    """

    def __init__(
        self,
        node: Node,
        skin: str = "/skin",
        on_touch: Callable[[Touch], None] | None = None,
        frames: bool = False,
        silent_after_s: float = SILENT_S,
        clocks_apart_s: float = 0.0,
    ) -> None:
        instance("node", node, Node)
        skin = node_name(skin)
        if not (on_touch is None or callable(on_touch)):
            raise ParameterError(f"on_touch is {on_touch!r}; it must be a function")
        if not 0 < seconds("silent_after_s", silent_after_s) <= LONGEST_S:
            raise ParameterError(
                f"silent_after_s is {silent_after_s:g} s; it must be above 0, and at most "
                f"{LONGEST_S:g} s"
            )
        argument("clocks_apart_s", clocks_apart_s, 0.0, (0.0, LONGEST_S), "s")
        wants_frames = argument("frames", frames, False)
        self.info: TactileSkinInfo | None = None
        self._places = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, dtype=np.float32)
        self._fault = ""  # of the last message, if it was refused
        self._node, self._on_touch = node, on_touch
        self._contacts: Touches | None = None
        ages = node.get_clock(), silent_after_s, clocks_apart_s
        self._newest, self._newest_array = Newest(*ages), Newest(*ages)
        self._array: TactileArray | None = None
        with _living():
            subscribe = node.create_subscription
            kind, take = TactileContacts, self._take_contacts
            heard = subscribe(kind, f"{skin}/contacts", take, FRESH, raw=True)
            self._rivals = Rivals(node, heard.topic_name)
            subscribe(TactileSkinInfo, f"{skin}/info", self._take_info, LATCHED)
            if wants_frames:
                qos = qos_profile_sensor_data
                subscribe(TactileArray, f"{skin}/tactile", self._take_array, qos)
            self._tare = node.create_client(Tare, f"{skin}/tare")
            self._get_state = node.create_client(GetState, f"{skin}/get_state")
            self._change_state = node.create_client(ChangeState, f"{skin}/change_state")
            node.create_timer(silent_after_s / 2, self._watch, clock=STEADY)

    @property
    def touch(self) -> Touch:
        """Return what the skin feels now."""
        found = self._contacts
        if found is None or not self._newest.is_of_now:
            return Touch(self._silence(), None)
        amounts = found.force_n, found.states["pressure_max"], found.states["velocity"]
        if problem := self._rivals.problem:
            pass
        elif not found.taxels_valid == found.taxels_in_service > 0:
            valid, of = found.taxels_valid, found.taxels_in_service
            problem = f"blind: {valid} of {of} taxels in service have a certain reading"
        elif found.absent:  # of a body
            problem = f"blind: absent patches: {len(found.absent)}"
        elif not all(np.isfinite(each).all() for each in amounts):
            problem = "uncertain: force, pressure or speed is unknown"
        elif not (found.touched or found.untouched):
            problem = "uncertain: a taxel reads below its zero, so whether it is touched is unknown"
        return Touch(problem, found)

    @property
    def frame(self) -> TaxelFrame | None:
        """Return the newest frame of the taxels; None if it is too old, or without its info."""
        array, info = self._array, self.info
        if array is None or info is None or array.info_id != info.info_id:
            return None
        if not self._newest_array.is_of_now or self._rivals.count > 1:
            return None
        try:
            pressure_pa, status = readings_of(array)
        except MessageError:
            return None
        places = self._places  # once: another info may come meanwhile, in the executor's thread
        if len(pressure_pa) != len(places[0]):
            return None
        valid = np.isfinite(pressure_pa) & is_certain(status)
        sigma_pa = np.array(array.sigma, dtype=np.float32)
        return TaxelFrame(array, pressure_pa, valid, *places, sigma_pa)

    def tare(self, force: bool | str = False, wait_s: float = 0.0) -> Tare.Response:
        """Take the present reading as zero; waits up to wait_s for what may pass.

        force: True, or "all": as Skin.tare. Returns the answer, with success, message and reason;
        raises PortError without one.
        """
        return self._call(self._tare, _tare_request(force, wait_s), wait_s)

    def tare_async(self, force: bool | str = False, wait_s: float = 0.0) -> Future:
        """Tare without waiting, for callbacks: the future is not done without a driver."""
        request = _tare_request(force, wait_s)
        with _living():
            return self._tare.call_async(request)

    def state(self) -> str:
        """Ask for the driver's lifecycle state: inactive, active, …; raises PortError."""
        return str(self._call(self._get_state, GetState.Request()).current_state.label)

    def change(self, transition: str) -> bool:
        """Ask for one of TRANSITIONS; returns whether it succeeded. Raises PortError."""
        if (number := TRANSITIONS.get(argument("transition", transition, ""))) is None:
            raise ParameterError(f"no transition {transition!r}: {', '.join(TRANSITIONS)}")
        request = ChangeState.Request(transition=Transition(id=number))
        return bool(self._call(self._change_state, request).success)

    def _call(self, client: Client, request: Any, wait_s: float = 0.0) -> Any:
        with _living():
            if not client.wait_for_service(timeout_sec=ANSWER_S):
                raise PortError(f"no {client.srv_name}: does the driver run, with that name?")
            future, done = client.call_async(request), threading.Event()
            future.add_done_callback(lambda _: done.set())
            if not done.wait(ANSWER_S + wait_s):
                client.remove_pending_request(future)
                raise PortError(
                    f"{client.srv_name} did not answer within {ANSWER_S + wait_s:g} s; does "
                    "another thread spin this node?"
                )
            return future.result()

    def _silence(self) -> str:
        silent_s = self._newest.silent_s
        if not self._rivals.count:
            return f"silent: no driver is seen to publish {self._rivals.topic}"
        if self._fault:
            return f"silent: what comes is not used: {self._fault}"
        since = f" for {silent_s:.1f} s" if silent_s < math.inf else " yet"
        return f"silent: nothing on {self._rivals.topic}{since}; /diagnostics tell why"

    def _watch(self) -> None:
        if self._on_touch and not self._newest.is_of_now:
            self._on_touch(self.touch)

    def _take_contacts(self, message: bytes, about: dict[str, Any]) -> None:
        self._rivals.hear(about)
        with self._told():
            found = Touches.read(message)
            frame = found.info_id, found.sequence
            if not self._newest.take(found.heading.stamp_ns, frame, found.stamp_uncertainty_s):
                raise MessageError(self._newest.refused)
            self._contacts = found
        if self._on_touch:
            self._on_touch(self.touch)

    def _take_info(self, message: TactileSkinInfo) -> None:
        with self._told():
            self._places, self.info = places_of(message), message

    def _take_array(self, message: TactileArray) -> None:
        frame, stamp_ns = (message.info_id, message.sequence), nanoseconds(message.header.stamp)
        if self._newest_array.take(stamp_ns, frame, message.stamp_uncertainty):
            self._array = message

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Notes why a message is refused, which would end the program's executor."""
        self._fault = ""
        try:
            yield
        except MessageError as error:
            self._fault = str(error)


@contextmanager
def _living() -> Iterator[None]:
    """Raises PortError where the client's node was destroyed."""
    try:
        yield
    except InvalidHandle:
        raise PortError("the node of this SkinClient was destroyed") from None


def node_name(name: str) -> str:
    """Check the name of a driver's node, and take off a slash at its end."""
    name = argument("skin", name, "").rstrip("/")
    try:
        validate_topic_name(name)
    except InvalidTopicNameException:
        raise ParameterError(
            f"skin is {name!r}, which is not a node's name; names look like /left_palm/skin"
        ) from None
    return name


def _tare_request(force: bool | str, wait_s: float) -> Tare.Request:
    wait_s = argument("wait_s", wait_s, 0.0, (0.0, LONGEST_S), "s")
    force = forced(force)
    return Tare.Request(force=bool(force), all=force == ALL, wait=wait_s)
