# SPDX-License-Identifier: Apache-2.0

"""Public calls in any order: before open, after close, twice, after an error."""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterator
from importlib.util import find_spec

from hypothesis import Verbosity, seed

from test.support.bounds import HangError, bounded
from test.support.call_orders import MACHINES, Calls, try_orders
from test.support.domains import own_domain

from ..outcome import Outcome, Plan

ORDERS = {"Decoder": 300, "Skin": 150, "Body": 15, "LiveObservation": 200, "SkinBatch": 300}
OF_ROS = {"SkinClient": 60, "TopicObservation": 60}
"""Orders of calls in a full run: as many as take a minute or two. A quick run tries a tenth."""
STEPS = 25
"""Most calls of an order; chosen."""
ROOM_BYTES = 4 << 30
"""Threads reserve much that they do not use."""
LONGEST_S = {True: 100.0, False: 600.0}
"""After which time a class's orders count as a hang, s."""


def run(plan: Plan) -> Iterator[Outcome]:
    """Try orders of calls of every class, and what works after them."""
    for name, orders in (ORDERS | (OF_ROS if find_spec("rclpy") else {})).items():
        yield tried(name, max(1, orders // 10) if plan.quick else orders, plan)


def machine(name: str) -> type[Calls]:
    """The state machine of a class; that of one which needs ROS has a domain of its own."""
    if name not in OF_ROS:
        return MACHINES[name]
    from test.support import ros_call_orders

    os.environ["ROS_DOMAIN_ID"] = str(own_domain())
    return ros_call_orders.MACHINES[name]


def tried(name: str, orders: int, plan: Plan) -> Outcome:
    """Try so many orders of the calls of a class."""
    crashes = hangs = 0
    longest_s = LONGEST_S[plan.quick]
    quietly = {"database": None, "verbosity": Verbosity.quiet}
    try:
        with bounded(ROOM_BYTES, longest_s, longest_s):
            try_orders(seed(plan.seed)(machine(name)), orders, STEPS, **quietly)
    except HangError:
        traceback.print_exc()
        hangs = 1
    except Exception:
        traceback.print_exc()
        crashes = 1
    finally:
        if name in OF_ROS:
            from test.support.ros_call_orders import Heard

            Heard.end_impostor()  # whose thread the process would wait for
    return Outcome(f"calls of {name} in any order", orders, crashes=crashes, hangs=hangs)
