"""What a running driver says of itself in /diagnostics."""

from __future__ import annotations

import time
from dataclasses import fields

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from ..driver import WAITING, Driver
from ..health import NodeState
from ..messages import Status
from ..pipeline import TactileFrame
from ..protocol import Counters
from .convert import listed

_COMPLAINTS = {
    NodeState.FAULTY: "words of some nodes contradict the code: check their supply and clock",
    NodeState.DOUBLED: "two nodes speak on one code row: check the numbers given to the nodes",
}
_LOSSES = {
    "sync_faults": "sync edges came late or not at all: the digitizer cannot keep up",
    "samples_lost": "the digitizer loses samples: ask for fewer samples_per_chip",
    "packets_dropped": "the link or this computer is too slow for the digitizer's packets",
    "command_errors": "commands reach the digitizer broken: check cable and baud",
}
"""What it means that a count of STATUS rises."""
_SLOW = 0.5
"""Share of the expected rate below which something is wrong."""


class StreamReport:
    """Level, text and values of a driver's stream; rates are since the report before."""

    def __init__(self) -> None:
        self._counted = (time.monotonic(), 0)
        self._status: Status | None = None

    def of(
        self, driver: Driver, latest: TactileFrame | None
    ) -> tuple[bytes, str, dict[str, object]]:
        """What there is to say now. latest: the newest frame."""
        rate_hz, expected_hz = self._rate_hz(driver), 1 / driver.pipeline.config.spec.frame_period_s
        level, text = _verdict(driver, rate_hz / expected_hz)
        loss = self._loss(driver.pipeline.status)
        wrong_tare = _below_rest(driver, latest)
        if level == DiagnosticStatus.OK and (loss or wrong_tare):
            level, text = DiagnosticStatus.WARN, loss or wrong_tare or ""
        values: dict[str, object] = {
            "rate (Hz)": f"{rate_hz:.2f}",
            "expected rate (Hz)": f"{expected_hz:.2f}",
            "connections": driver.connections,
            "rejected bursts": driver.pipeline.rejected,
        }
        values |= {**_health(driver), **_rest(driver), **_clocks(driver), **_counts(driver)}
        values["clipped samples (%)"] = f"{100 * latest.clipped:.1f}" if latest else ""
        return level, text, values

    def _loss(self, status: Status | None) -> str | None:
        """The gravest of what the digitizer has lost since the report before."""
        before, self._status = self._status, status
        if before is None or status is None:
            return None
        rising = (text for n, text in _LOSSES.items() if getattr(status, n) > getattr(before, n))
        return next(rising, None)

    def _rate_hz(self, driver: Driver) -> float:
        now, frames = time.monotonic(), driver.pipeline.counters.frames
        rate_hz = (frames - self._counted[1]) / max(now - self._counted[0], 1e-3)
        self._counted = (now, frames)
        return rate_hz


def _verdict(driver: Driver, rate: float) -> tuple[bytes, str]:
    """The worst that there is to say."""
    if driver.problem == WAITING:
        return DiagnosticStatus.WARN, driver.problem
    if driver.problem:
        return DiagnosticStatus.ERROR, driver.problem
    clocks = driver.pipeline.clocks
    if clocks is not None and clocks.busy:
        return DiagnosticStatus.OK, "roll call: measuring the nodes' clocks"
    if rate < _SLOW:
        return DiagnosticStatus.WARN, (
            f"frames come at {rate:.0%} of their rate: is the digitizer or this computer too slow, "
            "or is the line disturbed (see rejected bursts and lost samples)?"
        )
    if driver.pipeline.taxels.nobody_heard:
        return DiagnosticStatus.WARN, "frames arrive, but no node was heard: is the skin powered?"
    if clocks is not None and clocks.unresolved:
        return DiagnosticStatus.WARN, "clocks of some nodes leave them not told apart"
    for state, complaint in _COMPLAINTS.items():
        if driver.pipeline.health.nodes(state):
            return DiagnosticStatus.WARN, complaint
    if clocks is not None and clocks.problem:
        return DiagnosticStatus.WARN, clocks.problem
    return DiagnosticStatus.OK, "receiving"


def _below_rest(driver: Driver, latest: TactileFrame | None) -> str | None:
    """What there is to say of taxels that read less than nothing, as after a tare under load."""
    if latest is None:
        return None
    pressure_pa, layout = latest.readings.pressure_pa, driver.pipeline.config.layout
    below = np.flatnonzero(pressure_pa < -driver.pipeline.config.rest.contact_pa)
    if not len(below):
        return None
    nodes = listed(np.sort(layout.nodes[below]).tolist())
    return (
        f"nodes {nodes} read up to {-pressure_pa[below].min() / 1e3:.1f} kPa less than nothing: "
        "tare while nothing touches the skin"
    )


def _health(driver: Driver) -> dict[str, object]:
    health = driver.pipeline.health
    states = (NodeState.WEAK, NodeState.FAULTY, NodeState.DOUBLED)
    return {
        "missing nodes": listed(driver.pipeline.taxels.missing),
        **{f"{state.name.lower()} nodes": listed(health.nodes(state)) for state in states},
    }


def _rest(driver: Driver) -> dict[str, object]:
    """Drift, and the nodes whose rest is too far off to be drift."""
    taxels, tracker = driver.pipeline.taxels, driver.pipeline.taxels.chain.tracker
    drift_v = taxels.baseline.drift_v
    node = int(np.abs(drift_v).argmax())
    strays = tracker.strays_lsb(taxels.now_s) if tracker is not None else {}
    off = [f"{node} ({lsb:+.1f} LSB)" for node, lsb in strays.items()]
    return {
        "largest drift (mV)": f"{drift_v[node] * 1e3:.2f}, node {node + 1}",
        "nodes off their rest": listed(off) + ("; tare if nothing touches them" if off else ""),
    }


def _clocks(driver: Driver) -> dict[str, object]:
    clocks = driver.pipeline.clocks
    if clocks is None or not clocks.heard:
        return {}
    return {
        "node clocks heard": clocks.heard,
        "node clocks apart (chips)": f"{clocks.spread_chips:.2f}",
        "nodes taken apart by": "least squares" if clocks.decorrelated else "correlation",
        "nodes not told apart": listed(list(clocks.unresolved)),
    }


def _counts(driver: Driver) -> dict[str, object]:
    pipeline = driver.pipeline
    values: dict[str, object] = {
        _words(count.name): getattr(pipeline.counters, count.name)
        for count in fields(pipeline.counters)
    }
    packets, status = pipeline.packet_counts, pipeline.status
    for count in fields(Counters):
        if count.name != "text_bytes":
            values[_words(count.name)] = packets[count.name]
    for count in fields(status) if status else ():
        values["digitizer " + _words(count.name)] = getattr(status, count.name)
    return values


def _words(name: str) -> str:
    return name.replace("_", " ")
