# SPDX-License-Identifier: Apache-2.0

"""What a sync pulse on the data wire asks of an amplifier: `make amplifier SYNC=data`.

The digitizer pulls the line low, and the amplifier's output goes to its upper rail. After the pulse
Rf charges the line, the amplifier leaves its rail, and all settles, before the first chip. In a
frame the line must not dip as far as in a pulse: its amplifier has to be faster than chips need.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from amplifier import FrontEnd, step_left
from tactile_cdma.base.errors import SpecError
from tactile_cdma.hardware.passive import LISTEN_F
from tactile_cdma.wire._protocol import SYNC_FRAME, SYNC_LEAD, SYNC_UNIT_US

LEFT_S = (SYNC_LEAD - SYNC_FRAME) * SYNC_UNIT_US * 1e-6
"""From the end of the longest sync pulse to the first chip, s."""
AT_REST_V = 1e-3
"""Distance from its rest at which a line that was pulled low counts as at rest, V: a count."""
SPEED = 1.75
"""Gain-bandwidth and slew rate over what chips need, so that no flip of all pins is a pulse: behind
the Rin of 4 nodes, with 0.34 nF, the line dips to 4 mV below the highest threshold of 20 skins at
1.5, and stays 47 mV above it at 1.75 (make spice SYNC=data)."""
OVERLOAD_S = 2e-6
"""Time of an amplifier to leave its rail, s: of a slow one, OPA170; OPA310 takes 0.75 µs."""


def pulled(
    front: FrontEnd, wire_f: float | None = None, overload_s: float = OVERLOAD_S
) -> FrontEnd:
    """Return a front end whose line is pulled low.

    wire_f: capacitance of the line, F; None: that it was designed for. overload_s: see OVERLOAD_S.

    Raises SpecError, naming value, limit and cause, where it is not at rest in time.
    """
    if front.groups_stage or front.attenuator:
        what = (
            "in groups have a line each" if front.groups_stage else "with followers cannot listen"
        )
        raise SpecError(f"sync_wire is 'data', but nodes {what}: they need a sync wire, 'own'")
    faster = replace(front, nodes_stage=replace(front.nodes_stage, speed=SPEED))
    if (recovery := recovery_s(faster, wire_f, overload_s)) > LEFT_S:
        farad = front.nodes_stage.wire_f if wire_f is None else wire_f
        raise SpecError(
            f"with sync_wire 'data' the line is at rest {recovery * 1e6:.3g} µs after a pulse; it "
            f"must be within {LEFT_S * 1e6:g} µs, before the first chip: the amplifier takes "
            f"{overload_s * 1e6:g} µs to leave its rail, and Rf, "
            f"{front.nodes_stage.feedback_ohm:g} Ω, charges {farad * 1e9:.3g} nF of wire: take one "
            "that recovers faster, or a shorter wire"
        )
    return faster


def recovery_s(
    front: FrontEnd, wire_f: float | None = None, overload_s: float = OVERLOAD_S
) -> float:
    """Return the time from a pulse's end until the converter's input is at rest.

    Rf charges wire and Cf to half of what it comes from, the upper rail; then the amplifier leaves
    that, and feedback, filter and the nodes' inputs settle from there.
    """
    stage = front.nodes_stage
    farad = stage.wire_f if wire_f is None else wire_f
    charge_s = math.log(2) * stage.feedback_ohm * (farad + stage.feedback_f)
    divisor = max(stage.noise_gain, 1 + farad / stage.feedback_f)
    poles_s = (
        stage.feedback_ohm * stage.feedback_f,
        divisor / (2 * math.pi * stage.gain_bandwidth_hz),
        front.filter_ohm * front.filter_f,
        stage.input_ohm * LISTEN_F,
    )
    return charge_s + overload_s + settled_s(AT_REST_V / (front.supply_v / 2), poles_s)


def settled_s(left: float, poles_s: Sequence[float]) -> float:
    """Return when such low passes have left this share of a step, s."""
    low_s, high_s = 0.0, 40 * sum(poles_s)
    for _ in range(60):
        middle_s = (low_s + high_s) / 2
        low_s, high_s = (
            (middle_s, high_s) if step_left(middle_s, poles_s) > left else (low_s, middle_s)
        )
    return high_s
