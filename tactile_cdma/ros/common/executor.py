# SPDX-License-Identifier: Apache-2.0

"""An executor that keeps its wait set, and that no callback ends.

rclpy's own gathers all that a node has and makes a new wait set before every callback, and once
more after it, as every callback wakes the executor. A message to a node of 10 services, 10
publishers and 10 subscriptions takes 0.78 ms of CPU by its SingleThreadedExecutor, 0.14 by its
EventsExecutor and 0.09 to 0.13 by this one (rclpy 7.1.5, 1,000 messages at 200 Hz).

rclpy.experimental.EventsExecutor costs little more than this one, but in Jazzy's rclpy it calls
nobody while it waits without a time limit, fails where a callback wants what the middleware knows
of a message, waits for what is only Polled, too, and ends where a callback raises. By later
sources the last three hold on.
"""

import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.utilities import timeout_sec_to_nsec

from .failures import FAILURES

EVENTS_S = 0.2
"""Interval of looks at event handlers, s. Chosen: they report rare things, such as incompatible QoS
at a subscriber, and waiting for the 2 of every topic takes longer than for all else."""


class Polled(CallbackGroup):
    """Group of subscriptions that no executor waits for: messages stay in the middleware.

    What the middleware has to say about them, such as incompatible QoS, is heard all the same.
    """

    def can_execute(self, entity: object) -> bool:
        return not isinstance(entity, Subscription)


class LeanExecutor(Executor):
    """Runs the callbacks of nodes one after the other, in the thread that spins.

    For nodes with timers, subscriptions, services and event handlers, whose callbacks are plain
    functions; that of a service may be a coroutine, which is gone on with after every wait. Event
    handlers wake nobody. Guard conditions, clients and tasks are not served.

    What others send may make any callback raise, rclpy's own, too: see FAILURES.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._held = ExitStack()  # keeps what is waited for from being destroyed
        self._add: list[tuple[Callable[[Any], None], Any]] = []
        self._event_handlers: list[Any] = []
        self._call: dict[int, tuple[Callable[[Any], object], Any]] = {}  # by rcl's pointer
        self._turns: dict[int, int] = {}  # by rcl's pointer: number of the last call
        self._turn = 0
        self._has_changed, self._events_due_s = True, 0.0
        self._unanswered: list[tuple[Any, Any, Coroutine[Any, Any, Any]]] = []

    def add_node(self, node: Node) -> bool:
        """Serve a node too; returns False if it was served before."""
        self._has_changed = True
        return bool(super().add_node(node))

    def wake(self) -> None:
        """Gather anew; nodes call this when they create or destroy something."""
        self._has_changed = True
        super().wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """End; nobody may spin any more."""
        self._held.close()
        for *_, work in self._unanswered:
            work.close()
        return bool(super().shutdown(timeout_sec))

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait until something is ready, or for so long, s; call back for all that is ready."""
        if has_changed := self._has_changed:
            self._gather()
        wait_set = self._wait_set
        wait_set.clear_entities()
        for add, handle in self._add:
            add(handle)
        handlers = []
        if time.monotonic() >= self._events_due_s:
            self._events_due_s, handlers = time.monotonic() + EVENTS_S, self._event_handlers
        for handler in handlers:
            handler.add_to_wait_set(wait_set)
        wait_set.wait(timeout_sec_to_nsec(timeout_sec))
        if self._is_shutdown or not self._context.ok():
            return
        happened = [handler for handler in handlers if handler.is_ready(wait_set)]
        ready = self._ready(by_turns=has_changed)
        for handler in happened:
            FAILURES.survive(_call_handler, handler)
        for pointer in ready:
            if self._has_changed:  # perhaps destroyed by the last callback; others stay ready
                break
            self._turn += 1
            self._turns[pointer] = self._turn
            FAILURES.survive(*self._call[pointer])
        unanswered, self._unanswered = self._unanswered, []
        for waiting in unanswered:
            FAILURES.survive(self._go_on, waiting)

    def _ready(self, by_turns: bool) -> list[int]:
        """Return rcl's pointers to what is ready.

        by_turns: who was called longest ago comes first, as calls were broken off by a change: who
        creates something in every turn would starve others.
        """
        kinds = "timer", "subscription", "service"
        ready = [at for kind in kinds for at in self._wait_set.get_ready_entities(kind)]
        if by_turns:
            ready.sort(key=lambda pointer: self._turns.get(pointer, 0))
        return ready

    def _call_service(self, service: Any) -> None:
        request, header = service.handle.service_take_request(service.srv_type.Request)
        if header is None:  # rcl also reports one that somebody else took
            return
        with _answering(service, header):
            answer = service.callback(request, service.srv_type.Response())
            if not isinstance(answer, Coroutine):
                service.send_response(answer, header)
                return
        self._unanswered.append((service, header, answer))

    def _go_on(self, waiting: tuple[Any, Any, Coroutine[Any, Any, Any]]) -> None:
        """Let a service's coroutine look whether what it waits for, a timer, has come."""
        service, header, work = waiting
        with _answering(service, header):
            try:
                work.send(None)
            except StopIteration as end:
                service.send_response(end.value, header)
            else:
                self._unanswered.append(waiting)

    def _gather(self) -> None:
        """Take in what the nodes have at present, but for what their callback groups exclude."""
        self._has_changed = False
        self._held.close()
        nodes, context = self.get_nodes(), self._context.handle
        timers, subscriptions, services, self._event_handlers = (
            [entity for node in nodes for entity in getattr(node, kind) if self.can_execute(entity)]
            for kind in ("timers", "subscriptions", "services", "waitables")
        )
        guards = [self._guard, self._sigint_gc]
        kinds = subscriptions, guards, timers, (), services, self._event_handlers  # no clients
        self._wait_set = _rclpy.WaitSet(*map(len, kinds), context)
        self._add, self._call = [], {}
        for kind, entities, call in (
            ("guard_condition", guards, None),
            ("timer", timers, _call_timer),
            ("subscription", subscriptions, take_message),
            ("service", services, self._call_service),
        ):
            add = getattr(self._wait_set, f"add_{kind}")
            for entity in entities:
                self._held.enter_context(entity.handle)
                self._add.append((add, entity.handle))
                if call:
                    self._call[entity.handle.pointer] = call, entity
        self._turns = {at: turn for at, turn in self._turns.items() if at in self._call}
        for held in (*self._event_handlers, context):
            self._held.enter_context(held)


def take_message(subscription: Any) -> None:
    """Take a waiting message, if there is one, and call back with it.

    A callback that needs two arguments gets what the middleware knows of the message, too: a
    dictionary with source_timestamp and received_timestamp, ns. So it is in rclpy since Iron.
    """
    if taken := subscription.handle.take_message(subscription.msg_type, subscription.raw):
        both = subscription._callback_type is type(subscription).CallbackType.WithMessageInfo
        subscription.callback(*taken if both else taken[:1])


def _call_handler(handler: Any) -> None:
    if event := handler.take_data():
        handler.callback(event)


def _call_timer(timer: Any) -> None:
    if timer.handle.is_timer_ready():  # rcl also reports one that was cancelled meanwhile
        timer.handle.call_timer()
        timer.callback()


@contextmanager
def _answering(service: Any, header: Any) -> Iterator[None]:
    """Sends an empty answer where there is none, or the caller would wait."""
    try:
        yield
    except Exception:
        service.send_response(service.srv_type.Response(), header)
        raise
