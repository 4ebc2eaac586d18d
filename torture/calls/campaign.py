# SPDX-License-Identifier: Apache-2.0

"""Public calls in any order: before open, after close, twice, after an error."""

from __future__ import annotations

import traceback
from collections.abc import Iterator

from hypothesis import HealthCheck, Verbosity, seed, settings
from hypothesis.stateful import run_state_machine_as_test

from test.support.bounds import HangError, bounded
from test.support.call_orders import MACHINES

from ..outcome import Outcome, Plan

ORDERS = {"Decoder": 300, "Skin": 150, "Body": 15, "LiveObservation": 200, "SkinBatch": 300}
"""Orders of calls in a full run: as many as take a minute or two. A quick run tries a tenth."""
STEPS = 25
"""Most calls of an order; chosen."""
ROOM_BYTES = 4 << 30
"""Threads reserve much that they do not use."""
LONGEST_S = {True: 100.0, False: 600.0}
"""After which time a class's orders count as a hang, s."""


def run(plan: Plan) -> Iterator[Outcome]:
    """Try orders of calls of every class, and what works after them."""
    for name, orders in ORDERS.items():
        yield tried(name, max(1, orders // 10) if plan.quick else orders, plan)


def tried(name: str, orders: int, plan: Plan) -> Outcome:
    """Try so many orders of the calls of a class."""
    crashes = hangs = 0
    longest_s = LONGEST_S[plan.quick]
    rules = settings(
        max_examples=orders,
        stateful_step_count=STEPS,
        deadline=None,
        database=None,
        verbosity=Verbosity.quiet,
        suppress_health_check=list(HealthCheck),
    )
    try:
        with bounded(ROOM_BYTES, longest_s, longest_s):
            run_state_machine_as_test(seed(plan.seed)(MACHINES[name]), settings=rules)
    except HangError:
        traceback.print_exc()
        hangs = 1
    except Exception:
        traceback.print_exc()
        crashes = 1
    return Outcome(f"calls of {name} in any order", orders, crashes=crashes, hangs=hangs)
