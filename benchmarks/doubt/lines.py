# SPDX-License-Identifier: Apache-2.0

"""Conditions of the line: what disturbs it, and how its nodes talk.

A condition is a row of a table here; `conditions` puts them together with kinds of timing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from test.support.independent_line import Digitizer, Line, Skin, Talk

from .words import BLIND, TIMINGS
from .words import LineCondition as Condition

ORDERS = {
    12: Skin(nodes=11, order=12, period_chips=160),
    16: Skin(nodes=15, order=16, period_chips=208),
    20: Skin(),
}
PAPER = Skin(order=16, first_row=0, sign_seed=None, polarity=-1, period_chips=208)
LARGE = Skin(nodes=64, order=68, period_chips=880, amplitude_v=0.15)
ONE, TWO = Talk(together=1), Talk(together=2)
ALONE = Talk(speakers=1)
TWO_EQUAL = Talk(together=2, words="equal")
CHURN = Talk(share=0.3, stay=8, words="slow")
FEW = Talk(speakers=(0, 2, 3, 5), share=0.6, stay=8)
"""Joining and leaving: all nodes, and few, among them the one that some conditions impair."""


SKINS = (
    Condition("clean"),
    Condition("clean, learnt amplitude", learnt=True),
    Condition("clean, paper's skin", skin=PAPER),
    Condition("clean, unipolar", skin=Skin(drive="unipolar")),
    Condition("clean, parity", skin=Skin(parity=True, period_chips=300)),
    Condition("clean, 64 nodes", skin=LARGE),
    Condition("joining and leaving", talk=CHURN),
    Condition("joining and leaving, learnt amplitude", talk=CHURN, learnt=True),
    Condition("joining and leaving, paper's skin", talk=CHURN, skin=PAPER),
    Condition("two nodes", talk=TWO),
    Condition("noise, rho 12", Line(noise_v=0.112)),
    Condition("noise, rho 6", Line(noise_v=0.224), rough=True),
    Condition("noise, rho 6, joining and leaving", Line(noise_v=0.224), CHURN, rough=True),
)
"""Skins on a sound line, with more or less noise."""
TIMES = (
    Condition("skew 0.1 chip", Line(skew_chips=0.1)),
    Condition("skew 0.4 chip", Line(skew_chips=0.4), rough=True),
    Condition("a node 0.3 chip late", Line(late=((2, 0.3),)), FEW, rough=True),
    Condition("a node 0.6 chip late", Line(late=((2, 0.6),)), FEW, rough=True),
    Condition(
        "a node 0.6 chip late, two nodes", Line(late=((2, 0.6),)), Talk(speakers=(2, 9)), rough=True
    ),
    Condition("a node 2 chips late", Line(late=((2, 2.0),)), FEW, rough=True),
    Condition("edges jitter by 0.05 chip", Line(edge_jitter_chips=0.05)),
    Condition("edges jitter by 0.2 chip", Line(edge_jitter_chips=0.2), CHURN, rough=True),
    Condition("clock error 100 ppm", Line(clock_error=1e-4)),
    Condition("stretch 0.5 %", Line(stretch=0.005), CHURN, rough=True),
)
"""Chips that are not where they should be."""
VOLTAGES = (
    Condition("amplitudes spread by 10 %", Line(spread=0.1), CHURN),
    Condition("a node at 0.6 A", Line(gains=((2, 0.6),)), FEW),
    Condition("a node at 0.4 A", Line(gains=((2, 0.4),)), FEW, rough=True),
    Condition("a node at 1.5 A", Line(gains=((2, 1.5),)), FEW),
    Condition("a node at 4 A", Line(gains=((2, 4.0),)), FEW, rough=True),
    Condition("droop 20 %", Line(droop=0.2), CHURN),
    Condition("ripple 10 %, 300 Hz", Line(ripple=0.1, ripple_hz=300), FEW),
    Condition("rise 0.2, fall 0.4 chip", Line(rise_chips=0.2, fall_chips=0.4), FEW),
    Condition("low-pass 0.1 chip", Line(low_pass_chips=0.1)),
    Condition("low-pass 0.3 chip", Line(low_pass_chips=0.3), rough=True),
    Condition("low-pass 0.3 chip, one node", Line(low_pass_chips=0.3), ONE),
    Condition("low-pass 0.3 chip, one node alone", Line(low_pass_chips=0.3), ALONE),
    Condition(
        "low-pass 0.6 chip, joining and leaving", Line(low_pass_chips=0.6), CHURN, rough=True
    ),
    Condition("ringing 30 %", Line(ringing=0.3)),
    Condition("ringing 60 %, joining and leaving", Line(ringing=0.6), FEW, rough=True),
    Condition("high-pass 10 Hz", Line(high_pass_hz=10), CHURN),
    Condition("high-pass 100 Hz", Line(high_pass_hz=100), FEW),
    Condition("high-pass 500 Hz, two nodes", Line(high_pass_hz=500), TWO, rough=True),
    Condition("hum of A/3", Line(hum_v=0.1)),
    Condition("hum of A/3, two nodes", Line(hum_v=0.1), TWO),
    Condition("hum of 2 A", Line(hum_v=0.6), CHURN, rough=True),
    Condition("PWM of A/3 at half the chip rate", Line(hum_v=0.1, hum_hz=10_000), CHURN),
    Condition("100 impulses/s of 1 V", Line(impulses_hz=100), FEW),
    Condition("1000 impulses/s of 1 V", Line(impulses_hz=1000), rough=True),
    Condition("1000 impulses/s of 1 V, two nodes", Line(impulses_hz=1000), TWO, rough=True),
    Condition(
        "50 impulses/s of 5 V, 2 chips",
        Line(impulses_hz=50, impulse_v=5, impulse_chips=2),
        rough=True,
    ),
    Condition("20 jumps/s of A", Line(steps_hz=20, step_v=0.3), FEW, rough=True),
    Condition("100 jumps/s of 2 A", Line(steps_hz=100, step_v=0.6), FEW, rough=True),
)
"""Levels that are not what they should be."""
EIGHT = Skin(nodes=7, order=8, period_chips=104)
RAILS = (
    Condition("offset 1.05 x rail", Line(offset_v=6.3)),
    Condition("offset 1.3 x rail", Line(offset_v=7.8)),
    Condition("offset -1.3 x rail, joining and leaving", Line(offset_v=-7.8), FEW),
    Condition("offset 1.3 x rail, nobody speaks", Line(offset_v=7.8), Talk(share=0)),
    Condition("offset 0.9 x rail", Line(offset_v=5.4), rough=True),
    Condition("offset 0.9 x rail, joining and leaving", Line(offset_v=5.4), CHURN, rough=True),
    Condition("at the rail at times", Line(steps_hz=3, step_v=9.0), FEW, rough=True),
    *(
        Condition(
            f"a rail at {at:g} A on one side, a weak node, {words} words",
            Line(offset_v=0.3 * at - 6, gains=((1, 0.21),), noise_v=0.03),
            Talk(share=0.4, words=words),
            EIGHT,
            rough=True,
        )
        for at in (1, 1.4)
        for words in ("equal", "slow")
    ),
    Condition("amplifier clips at 3 sqrt(n) A", Line(amplifier_v=3.6)),
    Condition("amplifier clips at 1.5 sqrt(n) A", Line(amplifier_v=1.8), rough=True),
)
"""Lines of which a part cannot be seen."""

WALSH, LONG = (
    Skin(nodes=order - 1, order=order, period_chips=13 * order, amplitude_v=0.2)
    for order in (32, 40)
)
SEVERAL = Line(
    gains=((2, 0.2),), dropouts=((3, 0.3),), low_pass_chips=0.15, hum_v=0.3, hum_hz=200, onset=0.4
)
CLAIMS = (
    Condition("all at 0.2 A, rho 40", Line(gain=0.2, noise_v=0.034), CHURN, rough=True),
    Condition("all at 0.2 A from then on", Line(gain=0.2, onset=0.5), CHURN, rough=True),
    Condition("a node at 0.24 A", Line(gains=((2, 0.24),)), FEW, rough=True),
    Condition("a node at 0.17 A, rho 20", Line(gains=((2, 0.17),), noise_v=0.067), rough=True),
    Condition("a node at 0.18 A, alone", Line(gains=((2, 0.18),)), Talk(speakers=(2,)), rough=True),
    Condition("hum of 1 A, 250 Hz", Line(hum_v=0.2, hum_hz=250), FEW, LONG, rough=True),
    Condition("hum of 2 A, 200 Hz", Line(hum_v=0.4, hum_hz=200), ONE, LONG, rough=True),
    Condition("hum of 4 A, 300 Hz", Line(hum_v=0.8, hum_hz=300), ONE, WALSH, rough=True),
    Condition("hum of 2 A, 625 Hz", Line(hum_v=0.4, hum_hz=625), FEW, WALSH, rough=True),
    Condition("offset 0.8 A on row 0", Line(offset_v=0.24), Talk(share=0.3), PAPER, rough=True),
    Condition("offset -1.5 A on row 0", Line(offset_v=-0.45, onset=0.3), FEW, PAPER, rough=True),
    Condition("100 bursts/s of 5 A", Line(bursts_hz=100, burst_v=1.5), ONE, rough=True),
    Condition("a node drops out", Line(dropouts=((2, 0.5),)), FEW, rough=True),
    Condition("a node 0.5 % slow", Line(slow=((2, 0.005),)), rough=True),
    Condition("several at once", SEVERAL, FEW, rough=True),
)
"""Lines on which silence, or a word, has no evidence."""

SPARSE = Skin(nodes=256, order=64, period_chips=832, amplitude_v=0.15, sparse=True)
SOME = Talk(share=0.08)
SPARSE_LINES = (
    Condition("8 % speak", talk=SOME),
    Condition("8 % speak, equal words", talk=Talk(share=0.08, words="equal")),
    Condition("joining and leaving", talk=Talk(share=0.08, stay=8, words="slow")),
    Condition("a quarter at 0.6 A", Line(gains=tuple((i, 0.6) for i in range(0, 256, 4))), SOME),
    Condition("30 % speak", talk=Talk(share=0.3)),
    Condition("nodes 1 to 3 chips late", Line(late=((2, 1), (3, 2), (4, 3))), SOME),
    Condition("hum of A", Line(hum_v=0.15), SOME),
    Condition("hum of 2 A, 300 Hz", Line(hum_v=0.3, hum_hz=300, onset=0.5), SOME),
    Condition("one speaks, the line jumps", Line(steps_hz=20, step_v=0.05), Talk((3,), 0.2)),
    Condition("marks late", talk=SOME, digitizer=Digitizer(mark_shifts=(1, 2))),
    Condition("samples dropped", talk=SOME, digitizer=Digitizer(slip_share=0.3)),
)
"""Sparse codes, of which 31 nodes at a time are told apart. All are rough: the first frames, of
which the noise is learnt, are flagged; `make bench-sparse` counts what is certain."""


RESTARTED = Skin(
    nodes=48, order=64, period_chips=880, amplitude_v=0.15, restart_chips=64, guard_chips=3
)
RESTARTS = tuple(
    Condition(
        f"restarts, a node {late:g} chip late", Line(late=((5, late),)), Talk((5, 34), 0.9),
        RESTARTED, rough=late > 0,
    )
    for late in (0.0, 0.7, 1.0, 1.3)
)  # fmt: skip
"""Nodes that pause after each bit; one that is late may not move the frame to where it begins."""
SCRAMBLED_FAULTS = frozenset({
    "a node 0.6 chip late",
    "a node 2 chips late",
    "a node drops out",
    "restarts, a node 1 chip late",
    "hum of 2 A",
    "20 jumps/s of A",
    *(f"order {order}, {speak} speak, {fault}"
      for order, speak in ((16, 1), (24, 3))
      for fault in ("marks 1 or 2 chips late", "a sample dropped or doubled")),
})  # fmt: skip
"""Rough conditions that also run scrambled, named without their timing: one fault each."""


def conditions() -> Iterator[Condition]:
    """Yield all conditions, and after a sound one the same scrambled, where its skin can be."""
    for condition in plain_conditions():
        yield condition
        _, _, fault = condition.name.partition(": ")
        if condition.can_scramble and (not condition.rough or fault in SCRAMBLED_FAULTS):
            yield condition.scrambled()


def plain_conditions() -> Iterator[Condition]:
    """Yield all conditions as they are written here; names begin with how frames are timed."""
    for name, digitizer in TIMINGS.items():
        for condition in SKINS + TIMES + VOLTAGES + RAILS + CLAIMS:
            yield replace(condition, name=f"{name}: {condition.name}", digitizer=digitizer)
        for change, how in (
            ("5 losses/s", replace(digitizer, losses_hz=5)),
            ("8 bits", replace(digitizer, adc_bits=8)),
            ("16 samples per chip", replace(digitizer, samples_per_chip=16)),
        ):
            yield Condition(f"{name}: {change}", talk=FEW, digitizer=how)
        for ratio, rail_v in ((3, 3.6), (1.5, 1.8)):
            clipping = replace(digitizer, rail_v=rail_v)
            clips = f"{name}: rail at {ratio} sqrt(n) A"
            yield Condition(clips, digitizer=clipping, rough=ratio < 3)
        for order in (8, 24, 28, 32, 36, 40):
            skin = Skin(nodes=order - 1, order=order, period_chips=13 * order, amplitude_v=0.2)
            yield Condition(f"{name}: order {order}", talk=CHURN, skin=skin, digitizer=digitizer)
    for condition in SPARSE_LINES:
        name = f"sparse: {condition.name}"
        means = replace(condition.digitizer, integrated=True, samples_per_chip=8)
        yield replace(condition, name=name, skin=SPARSE, digitizer=means, rough=True)
    for condition in RESTARTS:
        yield replace(condition, name=f"marks: {condition.name}")
    yield from gap_conditions()
    yield from mark_conditions()


def mark_conditions() -> Iterator[Condition]:
    """Few nodes speak, and marks or samples are where they should not be."""
    moved: dict[str, dict[str, Any]] = {
        "marks 1 or 2 chips late": {"mark_shifts": (1.0, 2.0)},
        "marks 1 or 2 chips early": {"mark_shifts": (-1.0, -2.0)},
        "a sample dropped or doubled": {"slip_share": 0.3},
    }
    few = [(order, speak, "random") for order in (8, 16, 24) for speak in (1, 2, 3)]
    for order, speak, words in [*few, (64, 1, "extreme")]:
        skin = Skin(nodes=order - 1, order=order, period_chips=13 * order)
        for timing in ("marks", "means"):
            for how, change in moved.items():
                name = f"{timing}: order {order}, {speak} speak, {how}"
                talk, shifted = (
                    Talk(together=speak, words=words),
                    replace(TIMINGS[timing], **change),
                )
                yield Condition(name, Line(), talk, skin, shifted, rough=True)


def gap_conditions() -> Iterator[Condition]:
    """Yield conditions whose frames begin where no raster says."""
    for order, skin in ORDERS.items():
        for words, talk in (("random", TWO), ("equal", TWO_EQUAL)):
            for moves, line in (
                ("jitter 1 chip", Line(start_jitter_chips=1)),
                ("jitter 3 chips", Line(start_jitter_chips=3)),
                ("slips", Line(slip_share=0.03)),
                ("jitter 3 chips, low-pass", Line(start_jitter_chips=3, low_pass_chips=0.2)),
            ):
                name = f"gap: order {order}, two nodes, {words} words, {moves}"
                yield Condition(name, line, talk, skin, BLIND)
    unsteady = Line(start_jitter_chips=3, stretch=0.1)
    for name, line, talk in (
        ("jitter 3 chips", Line(start_jitter_chips=3), Talk()),
        ("jitter 3 chips, joining and leaving", Line(start_jitter_chips=3), CHURN),
        ("stretch 10 %", Line(stretch=0.1), Talk()),
        ("stretch 10 %, jitter 3 chips, joining and leaving", unsteady, CHURN),
        ("stretch 10 %, jitter 3 chips, two nodes", unsteady, TWO),
    ):
        yield Condition(f"gap: {name}", line, talk, digitizer=BLIND)
