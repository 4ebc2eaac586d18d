# SPDX-License-Identifier: Apache-2.0

"""Judges what is wrong with a running skin, and how bad it is, by its pipeline and its vitals.

One function per entry of /diagnostics; docs/diagnostics.md lists every finding with its limit.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from ..base.text import listed
from ..framing.frames import Clause
from ..readings.status import Status as TaxelStatus
from ..readings.taxels import Readings
from ..wire.messages import Status
from ..words.health import NodeState
from ..words.limits import LIMITS
from .digitizer import SourceWatch, spoken, sync_trouble
from .pipeline import Pipeline, TactileFrame
from .vitals import Window

SLOW, VERY_SLOW, FAST = 0.9, 0.5, 1.1
"""Shares of the expected frame rate beyond which something is wrong. Chosen: by default, a report
spans 78 frames, so one more or less makes no difference."""
LOST_SHARE = 0.01
"""Share of the frames whose loss is more than an accident; chosen."""
CLIPPED_SHARE = 0.01
"""Share of clipped samples; with random row signs, less is harmless (docs/results.md)."""
REJECTED_FOR = {
    "incomplete": "cut off: are samples lost, or is frame_period_ms too short?",
    "absurd": "not numbers, or absurd volts: is volts_per_count right?",
    "at_rail": "with the line at a rail, where nobody is heard: centre the amplifier's offset, or "
    "lower its gain (make amplifier)",
    "noisy": "with noise that would hide words: look for what disturbs the line, or raise the "
    "amplitude",
    "misfit": "explained by no words: check chip_us, order, bits and scramble, noise on the line, "
    "and whether nodes' clocks are off",
}
"""What to do about frames that are mostly rejected for one reason."""
DOUBTED_FOR = {
    Clause.ENERGY: "look for hum, spikes and clipping, and at edges that are slow or jitter",
    Clause.ATOMS: "look for a node whose clock is off, or whose number another one has",
    Clause.RIVALS: "are marks late, or samples lost? scramble: true rules this out",
    Clause.REST: "look for hum, and for nodes that are late; check bits and frame_period_ms",
    Clause.WORDS: "look for weak or late nodes; too many may speak at once",
}
"""What to do about frames that are mostly in doubt for one reason."""
DOUBTED_SHARE = 0.1
"""Share of the frames that may be in doubt by accident. A sound line has less than 0.01."""
REJECTED_SHARE = 0.1
"""Share of the line's bursts that may be rejected by accident; chosen."""
LATE_S, LATE_PERIODS = 0.05, 2.0
"""A mean latency above their sum (s, and frame periods) means that bytes wait somewhere. Chosen:
two frames and a scheduler's hiccup."""
BUSY_SHARE = 0.8
"""Share of a core above which the driver's thread has no reserve left; chosen."""
FULL_SHARE = 0.9
"""Share of a core above which the threads of a process wait for each other; chosen."""
DRIFT_PPM = 300.0
"""Largest difference of two sound clocks. Chosen: 3 × that of two 50 ppm crystals."""
BROKEN_SHARE = 0.1
"""Share of broken packets above which the link is of no use; chosen."""
OTHER_SENSORS = (
    "the simulated sensors have another curve than the parameters or the calibration file say, so "
    "that pressures are wrong: leave these out, or give the simulator the file (calibration=FILE)"
)

UNSOUND = {
    NodeState.DOUBLED: "two nodes speak on one code row: {}; check the numbers given to the nodes "
    "(tactile-cdma node), and amplitude_mv",
    NodeState.FAULTY: "words contradict the code: {}; check supply, clock and soldering",
    NodeState.WEAK: "much weaker on the line than they should be: {}; check supply and resistor",
}
"""What is wrong with nodes of these states, and what to do about it."""


RAISE_REPORTS = 2
"""Reports in a row that must find a state before it stands. Chosen: one odd second does not."""
CLEAR_REPORTS = 5
"""Reports in a row without a finding that end it. Chosen: long enough to be read."""


class Level(IntEnum):
    """Says how bad it is; values are those of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong.

    text: for people, with what to do about it.
    event: it has happened, so it stands at once; otherwise it is a state, which may pass.
    key: identifies it whatever figures are in the text; by default the text itself.
    """

    text: str
    level: Level = Level.WARN
    event: bool = False
    key: str = ""


class Settling:
    """Reports findings only after RAISE_REPORTS, and for CLEAR_REPORTS longer than they last.

    So levels do not flap.
    """

    def __init__(self) -> None:
        self._standing: dict[str, _Held] = {}

    def settle(self, found: Iterable[Finding]) -> list[Finding]:
        """Add another report's findings; returns those that stand now, worst first."""
        now = {finding.key or finding.text: finding for finding in found}
        for key, finding in now.items():
            held = self._standing.setdefault(key, _Held(finding))
            held.finding, held.absent = finding, 0
            held.seen += 1
        for key in [key for key in self._standing if key not in now]:
            held = self._standing[key]
            held.absent += 1
            if not held.stands or held.absent >= CLEAR_REPORTS:
                del self._standing[key]
        standing = [held.finding for held in self._standing.values() if held.stands]
        return sorted(standing, key=lambda finding: -finding.level)


@dataclass(slots=True)
class _Held:
    finding: Finding
    seen: int = 0
    absent: int = 0

    @property
    def stands(self) -> bool:
        return self.finding.event or self.seen >= RAISE_REPORTS


def worst(findings: Iterable[Finding]) -> tuple[Level, str]:
    """Return the highest level, and the texts of its findings; OK and "" without findings."""
    findings = list(findings)
    level = max((finding.level for finding in findings), default=Level.OK)
    return level, "; ".join(finding.text for finding in findings if finding.level == level)


def stream(pipeline: Pipeline, window: Window, latest: TactileFrame | None) -> Iterator[Finding]:
    """Judge the frames: their rate, losses and latency, and the line that they come from."""
    period_s = pipeline.config.spec.frame_period_s
    share = window.frames / window.seconds * period_s
    frames = max(window.frames, 1)
    if share < SLOW:
        key, level = ("slow", Level.WARN) if share >= VERY_SLOW else ("very slow", Level.ERROR)
        text = (
            f"frames come at {share:.0%} of their rate: is the digitizer, a replay or this "
            "computer too slow, or is the line disturbed (see rejected bursts, lost packets and "
            "CPU)?"
        )
        yield Finding(text, level, key=key)
    lost = window.rises.stream.lost_frames
    if lost > LOST_SHARE * (lost + frames):
        text = (
            f"{lost / (lost + frames):.0%} of the frames are lost: see lost packets, skipped "
            "bytes, digitizer samples lost and digitizer packets dropped (entry link); a stalled "
            "computer looks like this, too"
        )
        yield Finding(text, event=True, key="lost frames")
    rejections = window.rises.rejections
    if rejections.total > REJECTED_SHARE * (rejections.total + frames):
        text = (
            f"{rejections.total / window.seconds:.1f} bursts a second are no frame, mostly "
            f"{REJECTED_FOR[rejections.leading]}"
        )
        yield Finding(text, key="rejected")
    yield from _doubts(window)
    yield from _unasked(pipeline, window)
    if window.rises.overloads and (load := pipeline.load):
        text = (
            f"{window.rises.overloads} frames are flagged, because more nodes spoke at once than "
            f"the {load.capacity} that their codes tell apart, up to about {load.peak}, or some "
            "whose codes add up to nothing: raise order, or the nodes' thresholds; or is "
            "amplitude_mv too low?"
        )
        yield Finding(text, event=True, key="overload")
    if share > FAST:
        text = (
            f"frames come at {share:.0%} of their rate: a replay or simulation that hurries, or "
            "the digitizer's clock is fast"
        )
        yield Finding(text, key="fast")
    if window.latency_s > LATE_S + LATE_PERIODS * period_s:
        text = (
            f"frames come {window.latency_s * 1e3:.0f} ms late: this computer does not keep up; "
            "close other programs, or ask for fewer samples_per_chip"
        )
        yield Finding(text, key="late")
    if window.clipped > CLIPPED_SHARE:
        text = (
            f"{window.clipped:.0%} of the samples are at a rail: lower the amplifier's gain "
            "(make amplifier), or centre its offset"
        )
        yield Finding(text, key="clipped")
    if latest is not None:
        yield from off_rest(pipeline, latest.readings)


def _doubts(window: Window) -> Iterator[Finding]:
    """Frames whose certificate fails, and the clause that fails most often."""
    doubts = window.rises.doubts
    share = doubts.total() / max(window.frames, 1)
    if share > DOUBTED_SHARE:
        [(clause, _)] = doubts.most_common(1)
        text = f"{share:.0%} of the frames are in doubt, mostly since {clause.doubt}"
        yield Finding(f"{text}: {DOUBTED_FOR[clause]}", key="doubted")


def _unasked(pipeline: Pipeline, window: Window) -> Iterator[Finding]:
    """Losses after which the digitizer does not ask the nodes to speak."""
    rises, refused = window.rises, pipeline.digitizer.ask_refused
    if refused and (rises.stream.lost_frames or rises.rejections.total or rises.doubts.total()):
        text = (
            "after a loss nodes are UNHEARD until they speak by themselves, as the digitizer does "
            f"not ask them to ({spoken(refused)}): is its firmware older than this driver?"
        )
        yield Finding(text, event=True, key="unasked")


def nodes(
    pipeline: Pipeline, stuck: list[int], window: Window, mismatch: str | None = None
) -> Iterator[Finding]:
    """Judge the nodes, one by one. stuck: numbers of those that do not move.

    mismatch: that they scramble otherwise than the parameters say.
    """
    if mismatch:
        yield Finding(mismatch, Level.ERROR, event=True)
        return
    taxels, health = pipeline.taxels, pipeline.health
    dead, stale = taxels.dead, taxels.stale
    if 0 < taxels.in_service == len(dead) + len(stale):
        why = "frames arrive, but no node was heard: is the skin powered, is active_share too high?"
        yield Finding(why, Level.ERROR, event=True)
        return
    most, stated_mv = taxels.in_service // 2 + 1, 1e3 * (pipeline.config.spec.amplitude_v or 0.0)
    if len(health.nodes(NodeState.WEAK)) > most:
        found_mv = 1e3 * float(np.nanmedian(health.amplitude_v))
        text = (
            f"nearly all nodes are much weaker than amplitude_mv says: {found_mv:.3g} instead of "
            f"{stated_mv:g}. Are these the parameters of this skin (tactile-cdma doctor PORT "
            "checks amplitude and polarity), or is its supply low?"
        )
        yield Finding(text, Level.ERROR, event=True, key="weak")
        return
    if len(health.nodes(NodeState.DOUBLED)) > most:
        text = (
            f"nearly all nodes are much stronger than amplitude_mv says, which is {stated_mv:g}: "
            "set it to what the line shows (tactile-cdma doctor PORT measures that), or, of a "
            f"simulator, its own to this: sim://?amplitude_mv={stated_mv:g}"
        )
        yield Finding(text, event=True, key="amplitude")
        return
    unsound = {
        "never heard: {}; check supply, wiring (without a sync wire: AIN1 and line behind Rin), or "
        "mask them in the layout": dead,
        "fell silent: {}; check supply and wiring; stale_after_s must be longer than the nodes' "
        "heartbeat": stale,
        **{text: health.nodes(state) for state, text in UNSOUND.items()},
        "stuck while all nodes around them move: {}; check sensor and converter": stuck,
        "out of service, as dead_share allows: {}; what touches there is not felt": taxels.retired,
    }
    for text, numbers in unsound.items():
        if numbers:
            yield Finding(text.format(listed(numbers, "node")), event=True, key=text)
    node, rho = weakest(pipeline, window)
    if rho < LIMITS.low_rho:
        text = (
            f"node {node} is only {decibels(rho):.0f} dB above the noise, "
            f"{decibels(LIMITS.low_rho):.0f} dB are needed: look for what disturbs the line, or "
            "raise the amplitude"
        )
        yield Finding(text, key="snr")


def link(pipeline: Pipeline, window: Window) -> Iterator[Finding]:
    """Judge the way from the digitizer to here: bytes, packets, and its clock."""
    rises = window.rises
    stream, packets, digitizer = rises.stream, rises.packets, rises.digitizer or Status(uptime_us=0)
    info = pipeline.digitizer.info
    sync = (info and sync_trouble(info, pipeline.stream.level_v)) or (
        "sync edges came late or not at all: the digitizer cannot keep up; lower "
        "samples_per_chip, or make chip_us longer"
    )
    happened = {
        sync: digitizer.sync_faults,
        "the digitizer loses samples: ask for fewer samples_per_chip": digitizer.samples_lost,
        "the link or this computer is too slow for the digitizer's "
        "packets": digitizer.packets_dropped,
        "commands reach the digitizer broken: check cable and baud": digitizer.command_errors,
        "this computer does not keep up: bytes that waited too long were skipped; close other "
        "programs, or ask for fewer samples_per_chip": stream.skipped_bytes,
        "packets are missing: the link, or this computer, drops bytes; check the "
        "cable": packets.lost_packets,
        "the digitizer restarts packet numbering: does its supply reset it, or do two programs "
        "read it?": packets.jumps,
        "packets come twice or out of order: what lies between here and the "
        "digitizer?": packets.repeated_packets,
        "the digitizer restarted: check its supply": stream.restarts,
        "the digitizer's clock stood still, stepped, or has no crystal: stamps moved, see "
        "stamp_uncertainty": stream.clock_steps,
        "bytes arrive that are no packets: is baud right, is another program on the "
        "port?": packets.resyncs,
        "packets do not fit the protocol: update the digitizer's firmware or this "
        "driver": packets.malformed,
        "packets have impossible contents: update the digitizer's "
        "firmware": stream.implausible_packets,
    }
    yield from (Finding(text, event=True) for text, rise in happened.items() if rise)
    if broken := packets.crc_errors + packets.framing_errors:
        share = broken / (broken + packets.packets)
        key, level = ("noisy", Level.WARN) if share < BROKEN_SHARE else ("useless", Level.ERROR)
        text = (
            f"{share:.1%} of the packets arrive broken: check cable, grounding and baud, and that "
            "no other program reads the port"
        )
        yield Finding(text, level, event=True, key=key)
    if abs(off_ppm := pipeline.timeline.times.clock.drift_ppm) > DRIFT_PPM:
        text = f"the digitizer's clock is {off_ppm:+.0f} ppm off this computer's: check its crystal"
        yield Finding(text, key="drift")


def source(watch: SourceWatch) -> Iterator[Finding]:
    """Judge who measures: that it is a board, and still the same one."""
    texts = watch.unasked, watch.take_exchange()
    yield from (Finding(text, event=True) for text in texts if text)


def host(window: Window, drivers: int) -> Iterator[Finding]:
    """Judge this computer. drivers: how many publish under this one's name."""
    if drivers > 1:
        yield Finding(rivals(drivers), key="rivals")
    if window.thread_share > BUSY_SHARE:
        text = (
            f"decoding takes {window.thread_share:.0%} of a core: ask for fewer samples_per_chip, "
            "or publish less"
        )
        yield Finding(text, key="busy")
    elif window.process_share > FULL_SHARE:
        text = (
            f"its process takes {window.process_share:.0%} of a core, and Python uses hardly more: "
            "subscribe to less, or let fewer patches share it (process: in the body file)"
        )
        yield Finding(text, key="full")


def rivals(drivers: int) -> str:
    """Tell what is wrong where several drivers publish under one name."""
    return (
        f"{drivers} drivers have this name, and their frames are mixed: end one, or give it "
        "another name or ROS_DOMAIN_ID"
    )


def weakest(pipeline: Pipeline, window: Window) -> tuple[int, float]:
    """Find the heard node nearest to the noise, and its ρ = √N·a/σ; 0, NaN if unknown."""
    amplitude_v = pipeline.health.amplitude_v
    amplitude_v[np.array(pipeline.taxels.missing, np.intp) - 1] = np.nan
    if np.isnan(amplitude_v).all() or not window.noise_rms_v > 0:
        return 0, math.nan
    node = int(np.nanargmin(amplitude_v))
    rho = math.sqrt(pipeline.config.spec.order) * float(amplitude_v[node]) / window.noise_rms_v
    return node + 1, rho


def decibels(ratio: float) -> float:
    """Convert a ratio of voltages to dB."""
    return 20 * math.log10(ratio)


def off_rest(pipeline: Pipeline, readings: Readings) -> Iterator[Finding]:
    """Judge the taxels' zeros: some are none, as of a torn sensor, or after a tare under load."""
    pressure_pa, flags = readings.pressure_pa, readings.status
    node, contact_pa = pipeline.config.layout.nodes, pipeline.config.rest.contact_pa
    sound = ~np.append(True, pipeline.health.invalid)[node]
    torn = sound & (flags & TaxelStatus.FAULTY != 0)
    below = pressure_pa < -contact_pa
    numb = (flags & TaxelStatus.SATURATED != 0) & (pressure_pa <= contact_pa)
    below_kpa = -float(pressure_pa[below].min(initial=0)) / 1e3
    for key, taxels, text in (
        ("below rest", below,
         f"up to {below_kpa:.1f} kPa below zero: {{}}; tare while nothing touches the skin"),
        ("torn", torn, "farther above the voltage at rest than a contact would be below it: {}; "
         "check sensor and wiring, or, if the skin rests like this, tare with force: true"),
        ("numb", numb, "at the end of their range though they read no load: {}; tare while "
         "nothing touches the skin, and check v0_v and vref_v"),
    ):  # fmt: skip
        if taxels.any():
            named = listed(np.sort(node[taxels]).tolist(), "node")
            yield Finding(text.format(named), key=key)
