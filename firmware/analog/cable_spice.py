# SPDX-License-Identifier: Apache-2.0

"""Strips in a row on their cables in SPICE: supply, ground and sync are wires here, not ideal.

    regulator ─┬─ wire ─┬─ 3.3 V of strip 1 ─ wire ─┬─ of strip 2 …   each: capacitors, nodes' load
       100 µF ─┴─ amplifier, converter's reference  │
    ground ──── wire ─── ground of strip 1 ── wire ─┴─ …   ← current of a motor, in at the last one
    sync ────── wire ═══ crosstalk ═══ line ─ wire      if there is one, else the line is pulled low

A pin connects its Rin to its own strip's supply or ground, and lights its LED from it. So what
nodes say moves the supply, and what the supply, the ground or the sync wire does moves the line.
Nothing here is computed by the formulas of the decoder's simulator: levels are what the circuit
gives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from amplifier import NODE_F, RAIL_V, FrontEnd, design
from circuit import OPAMP, PIN_OHM, filter_lines, level_points, stage_lines
from ngspice import transients
from pulse import pulled
from pulse_spice import DRAIN_OHM, LEAD_S, PULL_OHM, PULSE_S
from tactile_cdma.base.arrays import Floats
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.config.parameters import DATA, OWN, Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.passive import LISTEN_F, PIN_F

STRIP_NODES = 8
FIRST_M, NEXT_M = 1.0, 0.15
"""Cable from the digitizer to the first strip, and from one to the next, m; chosen: 2 m in all for
64 nodes, as firmware/README.md has it."""
WIRE_OHM_M, CONTACT_OHM, WIRE_H_M = 0.22, 0.02, 0.7e-6
"""A wire of AWG 28, Ω/m; a crimped contact of JST's GH, of which each wire has two, Ω, by its data
sheet; inductance of a wire beside its return, H/m: chosen, as is usual of flat cables."""
GROUNDS, SYNC_GROUNDS = 1, 3
"""Ground wires of a strip's cable, of three wires, and of one with a sync wire: pins 2, 4 and 6."""
WIRE_F_M, COUPLED_F_M, LOOSE_F_M = 80e-12, 4e-12, 50e-12
"""Capacitance to its neighbours, of a wire between two grounds; between sync and line with ground
between them; and where they are loose wires side by side, F/m. Chosen, as is usual of such."""
REGULATOR_OHM, REGULATOR_H = 0.05, 1e-6
"""Output of a regulator of 1 A: 1 V at 1 A falls by some 1 %, and its loop ends near 10 kHz. Chosen
from the shape of such parts' curves; 100 µF carry what is faster."""
BULK_F, BULK_OHM = 60e-6, 5e-3
"""100 µF of X5R at 3.3 V, by its maker's curves some 60, and its series resistance."""
STRIP_F, STRIP_OHM = 6e-6, 5e-3
"""A strip's 8 × (1 µF + 2 × 100 nF) of X5R and X7R at 3.3 V, as they are left by it."""
IDLE_A, AWAKE_A, LED_A = 1.2e-3, 3.5e-3, 1.4e-3
"""An ATmega328P at 8 MHz and 3.3 V, asleep (idle) and awake, by its data sheet's curves, and the
LED of a high pin: (3.3 V − 1.9 V)/1 kΩ."""
SYNC_OHM, SYNC_INPUT_F = 68 + 20.0, 10e-12
"""The resistor at the sync wire's beginning with a buffer's output, Ω; a node's input, F."""
PROBE_V, PWM_HZ = 0.02, 10e3
"""Ground shift of the last strip that a run has, of which others are multiples; its frequency where
it is a motor's: half the chip rate of 50 µs, which adds up on one code row. Chosen."""
SHIFT_STEPS = 2 ** (np.arange(-4, 25) / 4)
"""Multiples of it that are tried: 10 mV to 1.3 V, each 19 % above the one before."""
BROWN_OUT_V = 2.9
"""Supply below which an ATmega328P may reset, V: BODLEVEL 101 is 2.5 to 2.9 V by its data sheet."""
STEPS = 50
"""Steps of a chip at least; edges have more, as the simulator chooses. Four times as many move no
figure by 1 %."""
AT_REST_V = 1e-3
"""Distance from rest below which a disturbance is over: a count of the converter, V."""

Wrong: TypeAlias = Callable[[Floats, Floats], int]
"""Counts the wrong words that are decoded from times, s, and volts."""


@dataclass(frozen=True, slots=True)
class Cabled:
    """A skin of strips. own_sync: with a sync wire.

    impedance: factor to all resistances and inductances of supply and ground. coupled_f_m: between
    sync and line. shift_v: of the last strip's ground, by a current through the cable's, constant
    or of PWM_HZ. joints_ohm: bad ones, in the first cable's supply and ground.
    """

    config: SkinConfig
    front: FrontEnd
    own_sync: bool = False
    impedance: float = 1.0
    coupled_f_m: float = COUPLED_F_M
    shift_v: float = 0.0
    shift_hz: float = 0.0
    joints_ohm: tuple[float, float] = (0.0, 0.0)

    @property
    def strips(self) -> int:
        """Return the number of strips."""
        return -(-self.config.spec.nodes // STRIP_NODES)

    @property
    def grounds(self) -> int:
        """Return the number of ground wires."""
        return SYNC_GROUNDS if self.own_sync else GROUNDS

    @property
    def ground_ohm(self) -> float:
        """Return the resistance from the last strip's ground to the digitizer's."""
        return sum(_wire_ohm(strip) for strip in range(self.strips)) / self.grounds * self.impedance


@dataclass(frozen=True)
class CableRun:
    """A frame of random words, and the next one's sync pulse. volts: as the converter reads it.

    supply_v: at the last strip, against its own ground. amplitude_v: (n,) of each node, by a fit of
    all chips.
    """

    cabled: Cabled
    codes: NDArray[np.int64]
    times: Floats
    volts: Floats
    supply_v: Floats
    amplitude_v: Floats

    @cached_property
    def frame(self) -> NDArray[np.bool_]:
        """Tell which times lie in the frame."""
        return self.times < self.cabled.config.spec.frame_s

    @property
    def sag_v(self) -> float:
        """Return by how much the last strip's supply is below 3.3 V in the frame, on average."""
        return float(self.cabled.front.supply_v - self.supply_v[self.frame].mean())

    @property
    def ripple_v(self) -> float:
        """Return how far it moves within the frame, peak to peak, once the frame has begun."""
        late = self.frame & (self.times > self.cabled.config.spec.frame_s / 4)
        return float(np.ptp(self.supply_v[late]))

    @property
    def level_off(self) -> float:
        """Return the largest deviation of a node's amplitude from what was computed, relative."""
        return float(np.abs(self.amplitude_v / self.cabled.front.amplitude_v - 1).max())

    def crosstalk(self) -> tuple[float, float]:
        """Return what the sync pulse does at the converter: largest step, V; s until it is over.

        From its last edge; the first chip comes LEAD_S − PULSE_S later.
        """
        spec = self.cabled.config.spec
        edge_s = spec.frame_period_s - LEAD_S
        before = (self.times > edge_s - LEAD_S) & (self.times < edge_s)
        rest_v = np.median(self.volts[before])
        after = self.times > edge_s
        off = np.abs(self.volts[after] - rest_v)
        (late,) = np.nonzero(off > AT_REST_V)
        fell_s = edge_s + PULSE_S
        over_s = self.times[after][late[-1]] - fell_s if late.size else 0.0
        return float(off.max()), max(float(over_s), 0.0)


def cabled_skin(nodes: int, own_sync: bool = False, **more: Value) -> Cabled:
    """Design a skin of strips with the calculator. more: its parameters. Raises SpecError."""
    wire = {"sync_wire": OWN if own_sync else DATA}
    period_ms = {"frame_period_ms": 36.0} if nodes > 2 * STRIP_NODES else {}
    values: dict[str, Value] = {"nodes": nodes, **wire, **period_ms, **more}
    asked = SkinConfig.of(values)
    front = design(asked.spec, asked.samples_per_chip)
    front = front if own_sync else pulled(front)
    stated: dict[str, Value] = {
        "polarity": front.polarity,
        "amplitude_mv": round(front.amplitude_v * 1e3, 2),
    }
    return Cabled(SkinConfig.of({**values, **stated}), front, own_sync)


def run_cabled(cabled: Cabled, seed: int = 1) -> CableRun:
    """Simulate a frame period of random words. Raises SpiceError."""
    spec, front = cabled.config.spec, cabled.front
    codes = np.random.default_rng(seed).integers(0, 2**spec.bits, spec.nodes)
    own = np.array(
        [
            line_chips(spec, codes, np.arange(spec.nodes) == node, amplitude_v=spec.polarity)
            for node in range(spec.nodes)
        ]
    )
    with TemporaryDirectory() as folder:
        files = [str(Path(folder) / f"levels{node}.txt") for node in range(spec.nodes)]
        for file, chips in zip(files, own, strict=True):
            levels = frame_levels(chips, spec).astype(np.float64)
            np.savetxt(file, level_points(levels, spec.chip_s), fmt="%.10g")
        found = transients(netlist(cabled, files))
    times, reference_v = found["time"], found["v(vdd0)"]
    # The converter's reference is the supply at the digitizer: counts are shares of it.
    volts = found["v(adc)"] / reference_v * front.supply_v
    last = cabled.strips
    late_v = np.interp((spec.places + 0.9) * spec.chip_s, times, volts)
    sent = (spec.polarity * own).reshape(spec.nodes, -1)
    model = np.column_stack([*sent, np.ones(sent.shape[1])])
    amplitude_v = np.linalg.lstsq(model, late_v, rcond=None)[0][:-1]
    supply_v = found[f"v(vdd{last})"] - found[f"v(vss{last})"]
    return CableRun(cabled, codes, times, volts, supply_v, amplitude_v)


def tolerated_shift_v(still: CableRun, shifted: CableRun, wrong: Wrong) -> tuple[float, str]:
    """Return the largest ground shift that was tried without harm, V, and what ends first.

    That is "words", or "supply" where a node's may reset. Pins are switches and resistors, so all
    moves by a multiple of what it did between these runs, until the amplifier is at a rail.
    """
    moved_v, supply_moved_v = (
        np.interp(still.times, shifted.times, after) - before
        for before, after in (
            (still.volts, shifted.volts),
            (still.supply_v, shifted.supply_v),
        )
    )
    top_v, best_v = still.cabled.front.supply_v - RAIL_V, 0.0
    for step in SHIFT_STEPS:
        if np.min(still.supply_v + step * supply_moved_v) < BROWN_OUT_V:
            return best_v, "supply"
        if wrong(still.times, np.clip(still.volts + step * moved_v, RAIL_V, top_v)):
            return best_v, "words"
        best_v = float(step * shifted.cabled.shift_v)
    return best_v, "nothing"


def netlist(cabled: Cabled, level_files: list[str]) -> str:
    """Write an analysis of a frame period, each node with a file of levels: −1, 1, 0 released."""
    spec, front, x = cabled.config.spec, cabled.front, cabled.impedance
    half_v, step_s = front.supply_v / 2, spec.chip_s / STEPS
    edge_s = spec.frame_period_s - LEAD_S
    lines = [
        f"* {spec.nodes} nodes on strips of {STRIP_NODES}, with their cables",
        OPAMP,
        f".param supply={front.supply_v:g}",
        f"vsupply source 0 {front.supply_v:g}",
        f"rregulator source slow {REGULATOR_OHM * x:g}",
        f"lregulator slow vdd0 {REGULATOR_H * x:g}",
        f"cbulk vdd0 bulk {BULK_F:g}",
        f"rbulk bulk 0 {BULK_OHM:g}",
        f"vawake awake 0 pwl(0 1 {spec.frame_s:g} 1 {spec.frame_s + 1e-6:g} 0)",
        f"vsync out0 0 pwl(0 0 {edge_s:.9g} 0 {edge_s + 2e-9:.12g} {front.supply_v:g} "
        f"{edge_s + PULSE_S:.9g} {front.supply_v:g} {edge_s + PULSE_S + 2e-9:.12g} 0)",
        *(
            [f"rsync out0 sync0 {SYNC_OHM:g}"]
            if cabled.own_sync
            else [f"bpull line0 0 i=v(out0)/{front.supply_v:g}*v(line0)/{PULL_OHM + DRAIN_OHM:g}"]
        ),
        *filter_lines(front),
        *(
            line.replace(" supply ", " vdd0 ")
            for line in stage_lines("out", front, front.nodes_stage, "line0")
        ),
        f"cline0 line0 0 {NODE_F:g}",
        *_shift(cabled),
    ]
    for strip in range(1, cabled.strips + 1):
        lines += [*_cable(strip, cabled), *_strip_supply(strip)]
    for node, file in enumerate(level_files):
        lines += _node(node, 1 + node // STRIP_NODES, file, cabled)
    saved = f"v(adc) v(vdd0) v(vdd{cabled.strips}) v(vss{cabled.strips})"
    rests = " ".join(f"v({name})={half_v:g}" for name in ("out", "adc", "line0", "halfout"))
    end = f".tran {step_s:g} {spec.frame_period_s:g} 0 {step_s:g}"
    return "\n".join([*lines, f".nodeset {rests}", end, f".save {saved}", ".end", ""])


def _shift(cabled: Cabled) -> Iterator[str]:
    """Write the foreign current into the last strip's ground, which returns at the digitizer's."""
    if not cabled.shift_v:
        return
    ampere = cabled.shift_v / cabled.ground_ohm
    wave = f"{ampere:g}"
    if cabled.shift_hz:
        period_s = 1 / cabled.shift_hz
        wave = f"pulse({-ampere:g} {ampere:g} 0 1e-6 1e-6 {period_s / 2 - 1e-6:.9g} {period_s:.9g})"
    yield f"ishift 0 vss{cabled.strips} {wave}"


def _wire_ohm(strip: int) -> float:
    """Return the resistance of one wire to this strip, counted from 0, of which the next is 1."""
    return WIRE_OHM_M * (NEXT_M if strip else FIRST_M) + 2 * CONTACT_OHM


def _cable(strip: int, cabled: Cabled) -> Iterator[str]:
    """Write the cable that ends at this strip, counted from 1."""
    metres, ohm = NEXT_M if strip > 1 else FIRST_M, _wire_ohm(strip - 1)
    henry, x = WIRE_H_M * metres, cabled.impedance
    before = {name: f"{name}{strip - 1}" for name in ("vdd", "vss", "line", "sync")}
    if strip == 1:
        before["vss"] = "0"
    wires = {"vdd": x, "vss": x / cabled.grounds, "line": 1.0, "sync": 1.0}
    if not cabled.own_sync:
        del wires["sync"]
    joints = dict(zip(("vdd", "vss"), cabled.joints_ohm, strict=True))
    for name, factor in wires.items():
        bad_ohm = joints.get(name, 0.0) if strip == 1 else 0.0
        yield f"r{name}{strip} {before[name]} w{name}{strip} {ohm * factor + bad_ohm:g}"
        yield f"l{name}{strip} w{name}{strip} {name}{strip} {henry * factor:g}"
        yield f"rloss{name}{strip} w{name}{strip} {name}{strip} 200"
    yield f"cline{strip} line{strip} vss{strip} {WIRE_F_M * metres + STRIP_NODES * NODE_F:g}"
    if not cabled.own_sync:
        return
    sync_f = WIRE_F_M * metres + STRIP_NODES * SYNC_INPUT_F
    yield f"csync{strip} sync{strip} vss{strip} {sync_f:g}"
    yield f"ccross{strip} line{strip} sync{strip} {cabled.coupled_f_m * metres:g}"


def _strip_supply(strip: int) -> Iterator[str]:
    yield f"cstrip{strip} vdd{strip} strip{strip} {STRIP_F:g}"
    yield f"rstrip{strip} strip{strip} vss{strip} {STRIP_OHM:g}"


def _node(node: int, strip: int, file: str, cabled: Cabled) -> Iterator[str]:
    """Write a node: its pin as two switches to its strip's supply and ground, LED, Rin, load."""
    n, vdd, vss = node, f"vdd{strip}", f"vss{strip}"
    level, high = f"v(level{n})", f"0.5*(abs(v(level{n}))+v(level{n}))"
    low = f"0.5*(abs({level})-{level})"
    yield f"a{n} %v([level{n}]) levels{n}"
    yield f'.model levels{n} filesource (file="{file}" amploffset=[0] amplscale=[1])'
    yield f"bhigh{n} {vdd} pin{n} i={high}*(v({vdd})-v(pin{n}))/{PIN_OHM:g}"
    yield f"blow{n} pin{n} {vss} i={low}*(v(pin{n})-v({vss}))/{PIN_OHM:g}"
    yield f"cpin{n} pin{n} {vss} {PIN_F if cabled.own_sync else LISTEN_F:g}"
    yield f"rin{n} pin{n} line{strip} {cabled.front.nodes_stage.input_ohm:g}"
    load = f"{IDLE_A:g}+v(awake)*{AWAKE_A - IDLE_A:g}+{high}*{LED_A:g}"
    yield f"bload{n} {vdd} {vss} i={load}"
