# SPDX-License-Identifier: Apache-2.0

"""What cables, discharges and inexact parts do to a skin, and how far each is from harm."""

from __future__ import annotations

from dataclasses import dataclass, replace

from cable_spice import (
    LOOSE_F_M,
    PROBE_V,
    PWM_HZ,
    Cabled,
    CableRun,
    cabled_skin,
    run_cabled,
    tolerated_shift_v,
)
from decoding import PERIODS, wrong_words
from esd_spice import CONTACTS, STRIKE_KV, needed_ohm, strike
from parts_spice import share_outside
from pulse_spice import LEAD_S, PULSE_S
from tactile_cdma.base.arrays import Floats
from tolerance import COARSE, scatter

NODES = 16, 64
"""Skins of strips; if quick, the first. Only of that, and if not quick, all runs are made."""
WORSE = 10.0
"""Factor to the impedance of supply and ground in a run of its own; chosen."""
TOLERANCES = 0.01, COARSE
SKINS, QUICK_SKINS = 2000, 400
"""Skins drawn from each class of parts: the share is known to 1.1 and 2.5 %."""


@dataclass(frozen=True, slots=True)
class Converter:
    """Is what decoding asks of a skin: a count, V, and the first sample of a chip, s."""

    count_v: float
    sample_s: float


def run_effects(quick: bool) -> tuple[int, int]:
    """Print a line per effect; returns words sent and wrong ones. Raises SpiceError."""
    words = wrong = 0
    for nodes in NODES[:1] if quick else NODES:
        sent, missed = _cables(cabled_skin(nodes), every=nodes == NODES[0] and not quick)
        words, wrong = words + sent, wrong + missed
    _parts(QUICK_SKINS if quick else SKINS)
    _discharges()
    return words, wrong


def missed_words(run: CableRun, times: Floats, volts: Floats) -> int:
    """Count the words of a run's frames that are wrong, with these volts at the converter."""
    front = run.cabled.front
    converter = Converter(front.count_v, front.sample_s)
    held_s = 0.0 if run.cabled.own_sync else LEAD_S
    return wrong_words(run.cabled.config, converter, times, volts, run.codes, held_s)


def _cables(cabled: Cabled, every: bool) -> tuple[int, int]:
    """Print what supply, crosstalk and ground do; returns words sent and wrong ones."""
    nodes = cabled.config.spec.nodes
    words = wrong = 0
    still = run_cabled(cabled)
    for run in [still, *([run_cabled(replace(cabled, impedance=WORSE))] if every else [])]:
        missed = missed_words(run, run.times, run.volts)
        words, wrong = words + PERIODS * nodes, wrong + missed
        print(
            f"supply={nodes} impedance_x={run.cabled.impedance:g} sag_mv={run.sag_v * 1e3:.1f} "
            f"ripple_mv={run.ripple_v * 1e3:.1f} amplitude_off={run.level_off:.4f} "
            f"wrong={missed}",
            flush=True,
        )
    wired = cabled_skin(nodes, own_sync=True)
    for skin in (wired, replace(wired, coupled_f_m=LOOSE_F_M)):
        run = run_cabled(skin)
        missed = missed_words(run, run.times, run.volts)
        step_v, over_s = run.crosstalk()
        words, wrong = words + PERIODS * nodes, wrong + missed
        print(
            f"crosstalk={nodes} coupled_pf_m={run.cabled.coupled_f_m * 1e12:g} "
            f"step_mv={step_v * 1e3:.0f} over_us={over_s * 1e6:.1f} "
            f"of_us={(LEAD_S - PULSE_S) * 1e6:g} wrong={missed}",
            flush=True,
        )
    for hertz in (0.0, PWM_HZ) if every else (PWM_HZ,):
        run = run_cabled(replace(cabled, shift_v=PROBE_V, shift_hz=hertz))
        missed = missed_words(run, run.times, run.volts)
        words, wrong = words + PERIODS * nodes, wrong + missed
        most_v, ends = tolerated_shift_v(
            still, run, lambda times, volts: missed_words(still, times, volts)
        )
        print(
            f"ground={nodes} shift_mv={PROBE_V * 1e3:g} hz={hertz:g} wrong={missed} "
            f"tolerated_mv={most_v * 1e3:.0f} then={ends}",
            flush=True,
        )
    return words, wrong


def _parts(skins: int) -> None:
    front = cabled_skin(NODES[0]).front
    for tolerance in TOLERANCES:
        share = share_outside(front, tolerance, skins)
        computed = scatter(front, tolerance, tolerance=tolerance).left
        print(
            f"parts={NODES[0]} tolerance={tolerance:.0%} skins={skins} outside={share:.3f} "
            f"computed={computed:.3f}",
            flush=True,
        )


def _discharges() -> None:
    for contact in CONTACTS:
        seen = strike(contact)
        within = seen.within(contact)
        output = f" output_ma={seen.output_a * 1e3:.0f}" if contact.feedback_f else ""
        needed = "" if within else f" needs_ohm={needed_ohm(contact):g}"
        guard = f"guard_ohm={contact.guard_ohm:g} " if contact.guard_ohm else ""
        print(
            f"discharge={contact.name} kv={STRIKE_KV:g} {guard}series_ohm={contact.series_ohm:g} "
            f"beyond_v={seen.beyond_v:.2f} pin_ma={seen.pin_a * 1e3:.3g} "
            f"limit_ma={contact.limit_a * 1e3:g} within={'yes' if within else 'no'}"
            f"{needed}{output}",
            flush=True,
        )
