# SPDX-License-Identifier: Apache-2.0

"""What is wrong with a running skin, judged from its pipeline and one Window of vitals.

One function per entry of /diagnostics; docs/diagnostics.md lists every finding with its limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..base.listing import listed
from ..words.decode import LOW_RHO
from ..words.health import NodeState
from .findings import Finding, Level
from .pipeline import Pipeline, TactileFrame
from .vitals import Window

SLOW, VERY_SLOW, FAST = 0.9, 0.5, 1.1
"""Shares of the expected frame rate below, or above, which something is wrong."""
LOST_SHARE = 0.01
"""Of the frames: a loss that is more than an accident."""
CLIPPED_SHARE = 0.01
"""Of the samples; random row signs make less than that harmless (docs/results.md)."""
REJECTED_SHARE = 0.1
"""Of the bursts on the line: more that are no frame are no accident."""
LATE_S, LATE_PERIODS = 0.05, 2.0
"""A mean latency above their sum means that bytes wait somewhere."""
BUSY_SHARE = 0.8
"""Of a core: above it the driver's thread has no reserve left."""
DRIFT_PPM = 300.0
"""Two sound crystals differ by less."""
BROKEN_SHARE = 0.1
"""Of the packets: with more of them broken the link is of no use."""
_PROBLEMS_OF_NODES = {
    NodeState.DOUBLED: (
        "two nodes speak on one code row: {}; check the numbers given to the nodes "
        "(tactile-cdma node), and amplitude_mv"
    ),
    NodeState.FAULTY: "words contradict the code: {}; check supply, clock and soldering",
    NodeState.WEAK: "much weaker on the line than they should be: {}; check supply and resistor",
}
LOSSES = {
    "digitizer_sync_faults": (
        "sync edges came late or not at all: the digitizer cannot keep up; "
        "lower samples_per_chip, or make chip_us longer"
    ),
    "digitizer_samples_lost": "the digitizer loses samples: ask for fewer samples_per_chip",
    "digitizer_packets_dropped": (
        "the link or this computer is too slow for the digitizer's packets"
    ),
    "digitizer_command_errors": "commands reach the digitizer broken: check cable and baud",
    "skipped_bytes": (
        "this computer does not keep up: what had waited too long was skipped; close other "
        "programs, or ask for fewer samples_per_chip"
    ),
    "lost_packets": "packets are missing: the link, or this computer, drops bytes; check the cable",
    "jumps": "the digitizer numbers its packets anew: is it reset by its supply, or read twice?",
    "repeated_packets": (
        "packets come twice, or after later ones: what is between here and the digitizer?"
    ),
    "restarts": "the digitizer began anew: check its supply",
    "resyncs": "runs of bytes that are no packet: is baud right, and nobody else on the port?",
    "malformed": "packets that no digitizer of this protocol sends: update whichever is older",
    "implausible_packets": "packets with impossible contents: update the digitizer's firmware",
}
"""What it means that a count rises."""


def stream(pipeline: Pipeline, window: Window, latest: TactileFrame | None) -> Iterator[Finding]:
    """Frames: their rate, losses, latency, and the line that they come from."""
    period_s = pipeline.config.spec.frame_period_s
    share = window.frames / window.seconds * period_s
    clocks = pipeline.clocks
    calling = clocks is not None and clocks.busy
    if share < SLOW and not calling:
        cause = (
            "is the digitizer, a replay or this computer too slow, or is the line disturbed (see "
            "rejected bursts, lost packets and CPU)?"
        )
        key, level = ("slow", Level.WARN) if share >= VERY_SLOW else ("very slow", Level.ERROR)
        yield Finding(key, level, f"frames come at {share:.0%} of their rate: {cause}")
    if share > FAST:
        yield Finding(
            "fast",
            Level.WARN,
            f"frames come at {share:.0%} of their rate: a replay or simulation that hurries, or "
            "the digitizer's clock is fast",
        )
    lost, frames = window.rises.get("lost_frames", 0), max(window.frames, 1)
    if lost > LOST_SHARE * (lost + frames) and not calling:
        yield Finding(
            "lost frames",
            Level.WARN,
            f"{lost / (lost + frames):.0%} of the frames are lost: see the counts of the link",
            event=True,
        )
    rejected = window.rises.get("rejected_bursts", 0)
    if rejected > REJECTED_SHARE * (rejected + frames) and not calling:
        yield Finding(
            "rejected",
            Level.WARN,
            f"{window.per_s('rejected_bursts'):.1f} bursts a second are no frame: check chip_us, "
            "order and bits, noise on the line, and whether nodes have clocks of their own",
        )
    if window.latency_s > LATE_S + LATE_PERIODS * period_s:
        yield Finding(
            "late",
            Level.WARN,
            f"frames come {window.latency_s * 1e3:.0f} ms late: this computer does not keep up; "
            "close other programs, or ask for fewer samples_per_chip",
        )
    if window.clipped > CLIPPED_SHARE:
        yield Finding(
            "clipped",
            Level.WARN,
            f"{window.clipped:.0%} of the samples are at a rail: lower the amplifier's gain "
            "(tactile-cdma amplifier), or centre its offset",
        )
    if (text := _below_rest(pipeline, latest)) is not None:
        yield Finding("below rest", Level.WARN, text)


def nodes(pipeline: Pipeline, stuck: list[int], window: Window) -> Iterator[Finding]:
    """The nodes, one by one. stuck: numbers of those that do not move."""
    taxels, clocks = pipeline.taxels, pipeline.clocks
    if clocks is not None and clocks.busy:
        return
    dead, stale = taxels.dead, taxels.stale
    if 0 < taxels.awaited == len(dead) + len(stale):
        text = "frames arrive, but no node was heard: is the skin powered, is threshold too high?"
        yield Finding("nobody", Level.ERROR, text, event=True)
        return
    if dead:
        yield Finding(
            "dead",
            Level.WARN,
            f"never heard: {listed(dead, 'node')}; check supply and wiring, or mask them in the "
            "layout",
            event=True,
        )
    if stale:
        yield Finding(
            "stale",
            Level.WARN,
            f"fell silent: {listed(stale, 'node')}; check supply and wiring; stale_after_s must "
            "be longer than the nodes' heartbeat",
            event=True,
        )
    for state, problem in _PROBLEMS_OF_NODES.items():
        if numbers := pipeline.health.nodes(state):
            text = problem.format(listed(numbers, "node"))
            yield Finding(state.name, Level.WARN, text, event=True)
    if stuck:
        yield Finding(
            "stuck",
            Level.WARN,
            f"do not move while all around them do: {listed(stuck, 'node')}; check sensor and "
            "converter",
            event=True,
        )
    node, rho = weakest(pipeline, window)
    if rho < LOW_RHO:
        yield Finding(
            "snr",
            Level.WARN,
            f"node {node} stands out of the noise by {decibels(rho):.0f} dB only, "
            f"{decibels(LOW_RHO):.0f} are needed: look for what disturbs the line, or raise the "
            "amplitude",
        )
    if clocks is not None and clocks.unresolved:
        text = f"clocks leave nodes not told apart: {listed(clocks.unresolved, 'node')}"
        yield Finding("unresolved", Level.WARN, text)
    if clocks is not None and clocks.problem:
        yield Finding("clocks", Level.WARN, clocks.problem)


def link(pipeline: Pipeline, window: Window) -> Iterator[Finding]:
    """The way from the digitizer to here: bytes, packets, and its clock."""
    for name, text in LOSSES.items():
        if window.rises.get(name):
            yield Finding(name, Level.WARN, text, event=True)
    broken = window.rises.get("crc_errors", 0) + window.rises.get("framing_errors", 0)
    if broken:
        share = broken / (broken + window.rises.get("packets", 0))
        key, level = ("noisy", Level.WARN) if share < BROKEN_SHARE else ("useless", Level.ERROR)
        yield Finding(
            key,
            level,
            f"{share:.1%} of the packets arrive broken: check cable, grounding and baud, and that "
            "no other program reads the port",
            event=True,
        )
    if abs(drift_ppm := pipeline.clock_drift_ppm) > DRIFT_PPM:
        yield Finding(
            "drift",
            Level.WARN,
            f"the digitizer's clock is {drift_ppm:+.0f} ppm off this computer's: check its crystal",
        )


def host(window: Window, drivers: int) -> Iterator[Finding]:
    """This computer. drivers: how many publish under this one's name."""
    if drivers > 1:
        yield Finding(
            "rivals",
            Level.WARN,
            f"{drivers} drivers have this name, and their frames are mixed up: end one, or give it "
            "another name or ROS_DOMAIN_ID",
        )
    if window.thread_share > BUSY_SHARE:
        yield Finding(
            "busy",
            Level.WARN,
            f"decoding takes {window.thread_share:.0%} of a core: ask for fewer samples_per_chip, "
            "or publish less",
        )


def weakest(pipeline: Pipeline, window: Window) -> tuple[int, float]:
    """The node that stands out of the noise least, and its ρ = √N·a/σ; 0 and NaN if unknown.

    Of those that are heard.
    """
    amplitude_v = pipeline.health.amplitude_v
    amplitude_v[[number - 1 for number in pipeline.taxels.missing]] = np.nan
    if np.isnan(amplitude_v).all() or not window.noise_rms_v > 0:
        return 0, math.nan
    node = int(np.nanargmin(amplitude_v))
    rho = math.sqrt(pipeline.config.spec.order) * float(amplitude_v[node]) / window.noise_rms_v
    return node + 1, rho


def decibels(ratio: float) -> float:
    """A ratio of voltages in dB."""
    return 20 * math.log10(ratio)


def _below_rest(pipeline: Pipeline, latest: TactileFrame | None) -> str | None:
    """What there is to say of taxels that read less than nothing, as after a tare under load."""
    if latest is None:
        return None
    pressure_pa, layout = latest.readings.pressure_pa, pipeline.config.layout
    below = np.flatnonzero(pressure_pa < -pipeline.config.rest.contact_pa)
    if not len(below):
        return None
    numbers = listed(np.sort(layout.nodes[below]).tolist(), "node")
    return (
        f"up to {-pressure_pa[below].min() / 1e3:.1f} kPa less than nothing: {numbers}; "
        "tare while nothing touches the skin"
    )
