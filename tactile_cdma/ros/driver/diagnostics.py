# SPDX-License-Identifier: Apache-2.0

"""A driver's entries in /diagnostics; docs/diagnostics.md explains every value."""

import math
from collections.abc import Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from ...base.text import listed
from ...driver import checkup
from ...driver.checkup import Level, Settling, worst
from ...driver.digitizer import SourceWatch
from ...driver.driver import NOT_YET, Driver
from ...driver.pipeline import Pipeline, TactileFrame
from ...driver.stream import Decisions
from ...driver.vitals import Window
from ...wire.identity import shown_id
from ...words.health import NodeState
from ..common.convert import diagnostic
from ..common.failures import FAILED, FAILURES

STREAM, NODES, LINK, SOURCE, HOST = "stream", "nodes", "link", "source", "host"
ENTRIES = (STREAM, NODES, LINK, SOURCE, HOST)
NO_FRAMES = "no frames come, see stream"
_OF_STREAM = ("frames", "lost frames", "rejected")
"""Counts whose names begin so stand in the entry of the stream; all others in that of the link."""

Values = Mapping[str, object]


class SkinReport:
    """Makes the entries of one skin, report after report."""

    def __init__(self, node: str) -> None:
        """node: fully qualified name of the node."""
        self._prefix = node.lstrip("/")
        self._hardware_id = ""
        self._decided = Decisions()  # up to the last report
        self._start_over()

    def _start_over(self) -> None:
        self._settling = {entry: Settling() for entry in ENTRIES}
        self._receiving = False  # at the last report

    def inactive(self, failure: str) -> list[DiagnosticStatus]:
        """Make the entries while no driver runs. failure: why it could not start, or empty."""
        self._start_over()
        judged = dict.fromkeys(ENTRIES, (Level.STALE, "not active"))
        if failure:
            judged[STREAM] = (Level.ERROR, failure)
        return self._entries(judged, {HOST: {FAILED: FAILURES.count}})

    def of(
        self,
        driver: Driver,
        watch: SourceWatch,
        latest: TactileFrame | None,
        tared: str,
        drivers: int,
    ) -> list[DiagnosticStatus]:
        """Make the entries of a running driver.

        watch: of the driver's port. latest: the newest frame. tared: when, or empty.
        drivers: number of those that publish under this node's name, itself included.
        """
        pipeline = driver.pipeline
        window = driver.vitals.take(pipeline)
        decided = pipeline.decisions.since(Decisions())
        rises, self._decided = decided.since(self._decided), decided
        if pipeline.digitizer.info is not None:
            self._hardware_id = shown_id(pipeline.digitizer.info.digitizer_id)
        values: dict[str, Values] = {
            STREAM: {
                **_stream_values(pipeline, window),
                "frames in doubt": self._decided.doubts.total(),
                "frames in doubt (%)": f"{100 * rises.doubts.total() / max(1, rises.frames):.1f}",
                "why in doubt": rises.reasons,
                "timings searched for": self._decided.searches,
            },
            NODES: {**_node_values(driver, window), "tared": tared or "not"},
            LINK: {"port": driver.url, **_link_values(driver, window)},
            SOURCE: {
                "skin": pipeline.config.skin,
                "digitizer": self._hardware_id,
                "origin": watch.source.origin.name.lower(),
                "measured by": watch.source.measured_by.name.lower(),
                "changes of the digitizer": watch.changes,
            },
            HOST: {
                "CPU of the process (%)": f"{100 * window.process_share:.1f}",
                "CPU of the driver's thread (%)": f"{100 * window.thread_share:.1f}",
                "drivers of this name": drivers,
                FAILED: FAILURES.count,
            },
        }
        if driver.problem:  # which leaves nodes and link unknown
            self._start_over()
            level = Level.WARN if driver.problem in NOT_YET else Level.ERROR
            judged = dict.fromkeys(ENTRIES, (Level.STALE, NO_FRAMES))
            judged |= {STREAM: (level, driver.problem), HOST: (Level.OK, "ok")}
            return self._entries(judged, values)
        found = {
            STREAM: checkup.stream(pipeline, window, latest),
            NODES: checkup.nodes(pipeline, driver.stuck.nodes, window, driver.scrambling.problem),
            LINK: checkup.link(pipeline, window),
            SOURCE: checkup.source(watch),
            HOST: checkup.host(window, drivers),
        }
        if not self._receiving:  # it would complain of a second that frames fill only in part
            found[STREAM] = found[LINK] = iter(())
        self._receiving = True
        judged = {entry: worst(self._settling[entry].settle(found[entry])) for entry in ENTRIES}
        level, text = judged[STREAM]
        judged[STREAM] = level, text or "receiving"
        level, text = judged[SOURCE]
        judged[SOURCE] = level, text or str(watch.source)
        return self._entries(judged, values)

    def _entries(
        self, judged: Mapping[str, tuple[Level, str]], values: Mapping[str, Values]
    ) -> list[DiagnosticStatus]:
        entries = []
        for entry, (level, text) in judged.items():
            name, said = f"{self._prefix}: {entry}", values.get(entry, {})
            status = diagnostic(name, bytes([level]), text or "ok", said, self._hardware_id)
            entries.append(status)
        return entries


def _stream_values(pipeline: Pipeline, window: Window) -> Values:
    return {
        "rate (Hz)": f"{window.frames / window.seconds:.2f}",
        "expected rate (Hz)": f"{1 / pipeline.config.spec.frame_period_s:.2f}",
        "latency (ms)": _number(window.latency_s * 1e3, 2),
        "latency, slowest (ms)": _number(window.slowest_s * 1e3, 2),
        "latency: line and link (ms)": _number(window.line_s * 1e3, 2),
        "latency: decoding (ms)": _number(window.decode_s * 1e3, 3),
        "latency: publishing (ms)": _number(window.publish_s * 1e3, 3),
        **_counts(window, of_stream=True),
        "lost frames (per s)": f"{window.rises.stream.lost_frames / window.seconds:.2f}",
        "noise floor (V rms)": _number(window.noise_rms_v, 6),
        "clipped samples (%)": f"{100 * window.clipped:.2f}",
        **_load_values(pipeline),
    }


def _load_values(pipeline: Pipeline) -> Values:
    if (load := pipeline.load) is None:
        return {}
    return {
        "nodes at once": load.now,
        "nodes at once, peak": load.peak,
        "nodes at once, capacity": load.capacity,
        "frames beyond the capacity": load.overloads,
        "groups by turns": 1 << pipeline.groups.now_log2,
    }


def _node_values(driver: Driver, window: Window) -> Values:
    pipeline = driver.pipeline
    taxels, health, tracker = pipeline.taxels, pipeline.health, pipeline.taxels.chain.tracker
    drift_v = taxels.baseline.drift_v
    drifting = int(np.abs(drift_v).argmax())
    strays = tracker.strays_lsb(taxels.now_s)
    off = [f"{node} ({lsb:+.1f} LSB)" for node, lsb in strays.items()]
    node, rho = checkup.weakest(pipeline, window)
    return {
        "dead nodes": listed(taxels.dead),
        "stale nodes": listed(taxels.stale),
        "unheard nodes": listed(taxels.unheard),
        "times all were asked to speak": pipeline.asking.requests,
        "weak nodes": listed(health.nodes(NodeState.WEAK)),
        "faulty nodes": listed(health.nodes(NodeState.FAULTY)),
        "doubled nodes": listed(health.nodes(NodeState.DOUBLED)),
        "stuck nodes": listed(driver.stuck.nodes),
        "weakest node": node or "",
        "SNR of the weakest node (dB)": f"{checkup.decibels(rho):.1f}" if node else "",
        "largest drift (mV)": f"{drift_v[drifting] * 1e3:.2f}, node {drifting + 1}",
        "nodes off their rest": listed(off) + ("; tare if nothing touches them" if off else ""),
    }


def _counts(window: Window, of_stream: bool) -> Values:
    named = window.totals.named().items()
    return {name: count for name, count in named if name.startswith(_OF_STREAM) == of_stream}


def _link_values(driver: Driver, window: Window) -> Values:
    packets, stream = window.rises.packets, window.rises.stream
    rises = {
        "crc errors": packets.crc_errors,
        "framing errors": packets.framing_errors,
        "lost packets": packets.lost_packets,
        "lost samples": stream.lost_samples,
    }
    return {
        "connections": driver.connections,
        "bytes (per s)": f"{packets.bytes / window.seconds:.0f}",
        **{f"{name} (per s)": f"{rise / window.seconds:.2f}" for name, rise in rises.items()},
        "backlog (bytes)": window.backlog_bytes,
        "digitizer clock drift (ppm)": _number(driver.pipeline.timeline.times.clock.drift_ppm, 1),
        **_counts(window, of_stream=False),
    }


def _number(value: float, digits: int) -> str:
    """Return a number as text; NaN, an unknown one, is empty."""
    return "" if math.isnan(value) else f"{value:.{digits}f}"
