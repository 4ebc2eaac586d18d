# SPDX-License-Identifier: Apache-2.0

"""Measures bit errors by stretch, jitter and clocks of the nodes' own, with each remedy.

    make bench-timing      QUICK=1: fewer frames and points

Bit errors of frames in which every node speaks, at ρ = 15, where noise alone causes none. Words are
random. Samples are instants, as a digitizer takes them. Frames that a method doesn't deliver count
as guessed: half of their bits are wrong.

- plain: chips where one fixed clock puts them (for nodes' own clocks: the mean of these).
- line, gap: frames are read where they are marked, or found by GapTiming, which knows no mark.
- resync: the nodes start anew every 32 chips, after 1 guard chip.

Times are those of one thread. "Age" is that of frames in stream time: from the end of the last chip
on the wire to the frame out of the pipeline, whose bytes come as a USB digitizer sends them;
computing counts with the CPU time it takes. With gap timing, packets of 3 ms are part of it, and
"proof": the silence that proves the end of a frame, counted when samples come chip by chip.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from benchmarks import style
from benchmarks.report import QUICK, Report, configured
from benchmarks.scale import replay
from benchmarks.skip import record
from tactile_cdma.base.kernel import ffi, lib, pointer
from tactile_cdma.code.encode import word_bits
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import rows_of
from tactile_cdma.config.parameters import GAP, Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.digitizer import quiet_uv
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.framing.frame_reader import BLUR, FrameReader
from tactile_cdma.framing.frames import LineFrame
from tactile_cdma.framing.gaps.gap_timing import SIDE_CHIPS, GapTiming
from tactile_cdma.framing.proposals import Proposer
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.nodes import NodeClocks
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Start
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words.words import Words
from test.support.simulated import configuration

RHO = 15.0
CHIP_S = 10e-6
RESYNC, GUARD = 32, 1
FRAMES = {16: 10, 64: 5, 256: 2} if QUICK else {16: 40, 64: 20, 256: 10}
NODES = (16, 64, 256)
STRETCHES = (0.0, 0.005, 0.11) if QUICK else (0.0, 0.0005, 0.002, 0.005, 0.02, 0.05, 0.08, 0.11)
JITTERS = (0.0, 0.1) if QUICK else (0.0, 0.02, 0.04, 0.06, 0.08, 0.1)
RATES = (0.001, 0.01) if QUICK else (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02)
DELAYS = (0.5,) if QUICK else (0.1, 0.25, 0.5)
DELAY_BESIDE_RATE = 0.3
SCRAMBLED: dict[int, dict[str, Value]] = {
    16: {},
    900: configured("thousand_skin"),
}
"""Skins whose decoding is timed with and without the scrambler: parameters by nodes."""
SCRAMBLED_ROUNDS = 5 if QUICK else 15

SKINS: dict[int, dict[str, Value]] = {
    16: {},
    256: {"nodes": 256, "chip_us": 6.25, "samples_per_chip": 4, "frame_period_ms": 20.0},
}
"""Skins whose frames are timed by line and by gaps: parameters by nodes."""
LEARNT = 45
"""Frames after which gap timing knows its raster."""
LIVE_FRAMES = 100 if QUICK else 400
LIVE_ROUNDS = 5 if QUICK else 15
POLL_S = 125e-6
"""Between two reads of a port: a microframe of USB."""


def frame_spec(nodes: int) -> FrameSpec:
    """Return a frame with room for the longest stretch and a gap, and a period of whole samples."""
    chips = 10 * FrameSpec(nodes=nodes, chip_s=1e-8, frame_period_s=1.0).order
    period_s = round(1.6 * chips) * CHIP_S
    return FrameSpec(nodes=nodes, chip_s=CHIP_S, frame_period_s=period_s)


def noise_of(spec: FrameSpec, per_chip: float) -> float:
    """Standard deviation of one sample's noise, V, for RHO with nodes of 1 V."""
    return float(np.sqrt(spec.order * per_chip) / RHO)


# One clock for all nodes


def common_lines(
    spec: FrameSpec, stretch: float, jitter: float, per_chip: int, rng: np.random.Generator
) -> Iterable[tuple[np.ndarray, np.ndarray]]:
    """Bits (k, n) of ±1 and the samples of a frame period, for as many frames as FRAMES says."""
    period = round(spec.frame_period_s / CHIP_S * per_chip)
    for _ in range(FRAMES[spec.nodes]):
        bits = rng.choice([-1.0, 1.0], (spec.bits, spec.nodes))
        levels = np.append(((bits * spec.signs) @ spec.node_rows).ravel(), 0.0)
        edges = np.arange(spec.chips + 1.0)
        edges[1:] += rng.uniform(-jitter, jitter, spec.chips)
        chip = np.searchsorted(edges, (np.arange(period) + 0.5) / per_chip / (1 + stretch), "right")
        yield bits, levels[chip - 1] + noise_of(spec, per_chip) * rng.normal(size=period)


def common_errors(spec: FrameSpec, stretch: float, jitter: float) -> dict[str, float]:
    """Return the share of wrong bits of each method."""
    per_chip, rng = 8, np.random.default_rng(1)
    frames = list(common_lines(spec, stretch, jitter, per_chip, rng))
    period, rate_hz = frames[0][1].size, per_chip / CHIP_S
    marked, gaps = Marked(spec, rate_hz), gap_timing(spec, rate_hz)
    found: dict[str, dict[int, np.ndarray]] = {"plain": {}, "line": {}, "gap": {}}
    before = noise_of(spec, per_chip) * rng.normal(size=period)  # a silent slot
    marked.reader.learn_rest(float(before.mean()), float(before.var()) / per_chip)
    blind = gaps.feed(0, before.astype(np.float32))
    for number, (_, line) in enumerate(frames, 1):
        volts = line.astype(np.float32)
        blind += gaps.feed(number * period, volts)
        chips = volts[: spec.chips * per_chip].reshape(spec.bits, spec.order, per_chip)
        found["plain"][number] = levels_of(chips.mean(axis=2), spec)
        frame = marked.read(volts)
        if frame is not None and frame.words is not None:
            found["line"][number] = said(frame.words, spec)
    blind += gaps.feed((len(frames) + 1) * period, before.astype(np.float32)) + gaps.flush()
    for frame in blind:
        if frame.words is not None:
            found["gap"][round(frame.start / period)] = said(frame.words, spec)
    return {
        name: float(np.mean([wrong(got.get(i + 1), bits) for i, (bits, _) in enumerate(frames)]))
        for name, got in found.items()
    }


class Marked:
    """Reads frames from their first sample on, and searches for a timing, as a stream does."""

    def __init__(self, spec: FrameSpec, rate_hz: float) -> None:
        self.reader = FrameReader(replace(spec, amplitude_v=1.0), rate_hz)
        self._proposer = Proposer(self.reader)

    def read(self, volts: np.ndarray) -> LineFrame | None:
        """Return a frame, None where it is rejected; volts: (m,) float32, without an offset."""
        verdict = self.reader.verdict(volts, searches=True)
        if verdict == lib.FRAME_SEARCH:
            chip = self._proposer.propose(volts, float(np.var(volts)) / RHO**2, 1)
            self.reader.propose(-0.5, chip or 0.0)
            verdict = self.reader.verdict(volts)
        return self.reader.taken(0) if verdict <= lib.FRAME_READ else None


def gap_timing(spec: FrameSpec, rate_hz: float) -> GapTiming:
    """Finds frames of nodes of 1 V."""
    reader = FrameReader(replace(spec, amplitude_v=1.0), rate_hz, side_chips=SIDE_CHIPS)
    return GapTiming(reader, rate_hz)


def chips_from(volts: np.ndarray, start: float, chip: float, count: int) -> np.ndarray:
    """Levels of so many chips on end, which begin there; start, chip: samples."""
    samples, sums = volts.astype(np.float32), np.empty(volts.size + 1)
    levels = np.empty(count, np.float32)
    given, out = pointer(samples, samples.size), pointer(sums, sums.size, written=True)
    lib.fit_sums(given, samples.size, 0.0, out)
    line = ffi.new("struct fit_line *", {"size": samples.size, "volts": given, "sums": out})
    fit = ffi.new("struct fit *", {"start": start, "chip": chip})
    lib.fit_levels(line, fit, BLUR, 0, count, pointer(levels, count, written=True))
    return levels


def levels_of(chips: np.ndarray, spec: FrameSpec) -> np.ndarray:
    """Levels of the nodes' bits, (k, n), of which the signs are the bits; chips: (k, N)."""
    return rows_of(chips.astype(np.float32), spec)[..., spec.rows] * spec.signs


def said(words: Words, spec: FrameSpec) -> np.ndarray:
    """Bits of words, (k, n) of ±1; 0, which is wrong, where a word is taken for silence."""
    return (2.0 * word_bits(words.codes, spec.bits).T - 1) * words.active


def wrong(values: np.ndarray | None, bits: np.ndarray) -> float:
    """Return the share of wrong bits in a frame."""
    return 0.5 if values is None else float(np.mean(np.sign(values) != bits))


# Clocks of the nodes' own


def own_line(
    spec: FrameSpec, clocks: NodeClocks, bits: np.ndarray, per_chip: int, size: int
) -> np.ndarray:
    """Samples of nodes that count their own chips; bits: (k, n), 0 for silence."""
    instants = (np.arange(size) + 0.5) / per_chip
    pitch = RESYNC + GUARD if spec.resync_chips else size
    slot, since = np.divmod(instants, pitch)
    length = RESYNC if spec.resync_chips else spec.chips
    line = np.zeros(size)
    for node in np.flatnonzero(bits.any(axis=0)):
        step = (since - clocks.delay_chips[node]) / (1 + clocks.rate_error[node])
        chip = np.floor(step).astype(int)
        inside = (chip >= 0) & (chip < length)
        chip = (chip + slot.astype(int) * length)[inside]
        inside[inside], chip = chip < spec.chips, chip[chip < spec.chips]
        row = spec.signs[node] * spec.node_rows[node]
        line[inside] += bits[chip // spec.order, node] * row[chip % spec.order]
    return line


def own_errors(nodes: int, rate: float, delay: float) -> dict[str, float]:
    """Return the share of wrong bits of each method."""
    per_chip, rng = 2, np.random.default_rng(2)
    spec = frame_spec(nodes)
    resynced = replace(spec, resync_chips=RESYNC, guard_chips=GUARD)
    clocks = NodeClocks(rng.uniform(0, delay, nodes), rng.uniform(-rate, rate, nodes))
    noise = noise_of(spec, per_chip)
    period = round(spec.frame_period_s / CHIP_S * per_chip)
    start = clocks.delay_chips.mean() * per_chip - 0.5
    mean_chip, chip = (1 + clocks.rate_error.mean()) * per_chip, float(per_chip)
    methods = {"plain": (spec, mean_chip), "resync": (resynced, chip)}
    errors = dict.fromkeys(methods, 0.0)
    for _ in range(FRAMES[nodes]):
        bits = rng.choice([-1.0, 1.0], (spec.bits, nodes))
        shared = noise * rng.normal(size=period)
        for name, (some, chip_samples) in methods.items():
            line = own_line(some, clocks, bits, per_chip, period) + shared
            chips = chips_from(line, start, chip_samples, some.span_chips)[some.places]
            chips = chips.reshape(some.bits, some.order)
            errors[name] += wrong(levels_of(chips, some), bits) / FRAMES[nodes]
    return errors


def scrambling_costs(report: Report) -> dict[int, float]:
    """Table of CPU times per frame of replay; returns by what the scrambler multiplies them.

    Plain and scrambled in turns, because the speed of a machine drifts; ratios are those of turns.
    """
    rows: list[list[object]] = []
    middle: dict[int, float] = {}
    for nodes, values in SCRAMBLED.items():
        skins = []
        for scramble in (False, True):
            config = SkinConfig.of({"nodes": nodes, **values, "scramble": scramble})
            reads = record(config, 1.0, True, 100 if QUICK else 1000).reads
            skins.append((config, [(data, t_host) for t_host, data in reads]))
        turns = np.array([[replay(*skin) for skin in skins] for _ in range(SCRAMBLED_ROUNDS)])
        plain_s, scrambled_s = np.median(turns, axis=0)
        low, middle[nodes], high = np.quantile(turns[:, 1] / turns[:, 0], (0.25, 0.5, 0.75))
        rows.append([nodes, 1e6 * plain_s, 1e6 * scrambled_s, middle[nodes], low, high])
    headers = "nodes,replay µs,scrambled µs,ratio (median),lower quartile,upper quartile"
    report.table(headers.split(","), rows)
    return middle


# Line and gap timing through the pipeline


def live_reads(config: SkinConfig, stretch: float) -> list[tuple[float, bytes]]:
    """Return what a digitizer sends while all nodes speak: time of each read, s, and its bytes."""
    now_s, reads, writer = [0.0], list[tuple[float, bytes]](), PacketWriter()
    options = SimOptions.from_url(f"sim://?scene=all&threshold=0&seed=1&stretch={stretch}")
    digitizer = VirtualDigitizer(options, lambda: now_s[0])
    quiet = 0 if config.timing == GAP else quiet_uv(config.spec)
    for command in (configuration(config, quiet), Start()):
        digitizer.receive(writer.encode(command))
    for number in range(int(LIVE_FRAMES * config.spec.frame_period_s / POLL_S)):
        now_s[0] = number * POLL_S
        digitizer.advance()
        if digitizer.pending:
            reads.append((now_s[0], digitizer.take(digitizer.pending)))
    return reads


def live_ages(config: SkinConfig, reads: list[tuple[float, bytes]]) -> list[float]:
    """Return the frames' ages, s, once the raster is known."""
    pipeline, ages = Pipeline(config), list[float]()
    for t_s, data in reads:
        begin_s = time.thread_time()
        frames = pipeline.feed(data, t_s)
        t_out_s = t_s + time.thread_time() - begin_s
        ages += [
            t_out_s - frame.t_start - config.spec.span_chips * frame.chip_s for frame in frames
        ]
    return ages[LEARNT:]


def live_cost(config: SkinConfig, reads: list[tuple[float, bytes]]) -> float:
    """CPU time per frame, s, once the raster is known; a frame period's bytes at once.

    A driver's wait for a frame does not return between reads, either.
    """
    pipeline, frames, spent_s, periods = Pipeline(config), 0, 0.0, dict[int, bytes]()
    for t_s, data in reads:
        period = int(t_s / config.spec.frame_period_s)
        periods[period] = periods.get(period, b"") + data
    for period, data in periods.items():
        begin_s = time.thread_time()
        count = len(pipeline.feed(data, period * config.spec.frame_period_s))
        if period >= LEARNT:
            spent_s, frames = spent_s + time.thread_time() - begin_s, frames + count
    return spent_s / frames


def proof_chips(nodes: int) -> float:
    """Return chips of silence after which a frame is given, in the middle."""
    spec, per_chip, rng = frame_spec(nodes), 4, np.random.default_rng(5)
    timing, taken, chips = gap_timing(spec, per_chip / CHIP_S), 0, list[float]()
    lines = [
        line
        for _ in range(60 // FRAMES[nodes] + 1)
        for _, line in common_lines(spec, 0.0, 0.0, per_chip, rng)
    ]
    for volts in np.concatenate(lines).astype(np.float32).reshape(-1, per_chip):
        frames = timing.feed(taken, volts)
        taken += per_chip
        chips += [(taken - frame.start) / frame.chip_samples - spec.chips for frame in frames]
    return float(np.median(chips[LEARNT:]))


def line_and_gap(report: Report) -> dict[str, float]:
    """Table of CPU time and age per frame with either timing; the figures of the last line.

    In turns, because the speed of a machine drifts.
    """
    rows, figures = [], dict[str, float]()
    for nodes, values in SKINS.items():
        skins = {}
        for timing, stretch in (("line", 0.0), ("gap", 0.0), ("gap", 0.1)):
            config = SkinConfig.of({**values, "timing": timing})
            skins[timing, stretch] = config, live_reads(config, stretch)
        turns = [{key: live_cost(*skin) for key, skin in skins.items()} for _ in range(LIVE_ROUNDS)]
        for (timing, stretch), skin in skins.items():
            took_s = float(np.median([turn[timing, stretch] for turn in turns]))
            ages_s = live_ages(*skin)
            middle_ms, last_ms = 1e3 * np.quantile(ages_s, (0.5, 0.99))
            proof_ms = 1e3 * proof_chips(nodes) * config.spec.chip_s if timing == "gap" else 0.0
            rows.append([nodes, timing, stretch, 1e6 * took_s, middle_ms, last_ms, proof_ms])
            if not stretch:
                figures[f"{timing}_us_{nodes}"] = 1e6 * took_s
                if nodes == 16:
                    figures[f"{timing}_age_ms"] = middle_ms
                    figures |= {"gap_p99_ms": last_ms, "gap_proof_ms": proof_ms}
    headers = "nodes,timing,stretch to,µs/frame,age ms,p99,proof ms"
    report.table(headers.split(","), rows)
    return figures


WAYS = {
    "plain": style.GREY,
    "line": style.BLUE,
    "gap": style.ORANGE,
    "resync": style.GREEN,
}
"""Methods in pictures, with their colours."""
STRETCH, CLOCK, DELAY = "stretch of all, %", "clocks off by up to, %", "delays up to, chips"


def panel(
    report: Report, label: str, points: Iterable[tuple[int, float, dict[str, float]]]
) -> dict[str, float]:
    """Report points (nodes, value, errors) by a table; returns each method's worst."""
    kept = list(points)
    names = [name for name in WAYS if name in kept[0][2]]
    columns = [*names, *(name for name in kept[0][2] if name not in names)]
    rows = [[nodes, value, *(found[name] for name in columns)] for nodes, value, found in kept]
    report.table(["nodes", label, *columns], rows)
    return {name: max(found[name] for _, _, found in kept) for name in names}


def picture(tables: list[list[list[Any]]]) -> Figure:
    """Draw bit error rates: a row of panels for each number of nodes."""
    figure = style.sheet(700)
    panels = figure.subplots(len(NODES), 3, sharey=True, sharex="col")
    shown = [next(t for t in tables if t[0][1] == label) for label in (STRETCH, CLOCK, DELAY)]
    for axes_of_nodes, nodes in zip(panels, NODES, strict=True):
        for axes, (heading, *rows) in zip(axes_of_nodes, shown, strict=True):
            own = [row for row in rows if row[0] == nodes]
            for number, (name, colour) in enumerate(WAYS.items()):
                if name in heading:
                    errors = [max(row[heading.index(name)], LEAST) for row in own]
                    marker = style.MARKERS[number]
                    axes.plot([row[1] for row in own], errors, color=colour, marker=marker, ms=5,
                              lw=(5, 5, 2, 2)[number])  # fmt: skip
            axes.set(yscale="log", ylim=(LEAST / 1.5, 1), yticks=[LEAST, 1e-3, 1])
            axes.set_yticklabels(["none", "10⁻³", "1"])
        axes_of_nodes[0].set_ylabel(f"{nodes} nodes")
    for axes, table in zip(panels[-1], shown, strict=True):
        axes.set_xlabel(table[0][1])
    panels[0][0].set_title("bit error rate")
    for number, (name, colour) in enumerate(WAYS.items()):
        panels[0][0].plot([], [], color=colour, marker=style.MARKERS[number], label=NAMES[name])
    figure.legend(loc="outside upper center", ncols=4)
    return figure


NAMES = {
    "plain": "fixed clock",
    "line": "marked frames",
    "gap": "found by gaps",
    "resync": "restarts",
}
LEAST = 1e-5
"""Where no error at all is drawn."""


def main() -> None:
    report = Report("timing", f"Bit errors of timing, ρ = {RHO:g}")
    worst = errors(report)
    scrambling = scrambling_costs(report)
    live = line_and_gap(report)
    report.finish(
        picture(report.tables),
        plain_ber=max(some["plain"] for some in worst[2:]),
        tracked_ber=max(some[name] for some in worst[:2] for name in ("line", "gap")),
        resync_ber=max(some["resync"] for some in worst[2:]),
        scrambled_cost_16=scrambling[16],
        scrambled_cost_900=scrambling[900],
        **live,
    )


def errors(report: Report) -> list[dict[str, float]]:
    """Report the bit errors by stretch, jitter, clocks and delays; each one's worst by method."""
    beside = DELAY_BESIDE_RATE
    cases = {
        STRETCH: (
            (n, 100 * x, common_errors(frame_spec(n), x, 0.0)) for n in NODES for x in STRETCHES
        ),
        "jitter, chips": (
            (n, x, common_errors(frame_spec(n), 0.0, x)) for n in NODES for x in JITTERS
        ),
        CLOCK: ((n, 100 * x, own_errors(n, x, beside)) for n in NODES for x in RATES),
        DELAY: ((n, x, own_errors(n, 0.0, x)) for n in NODES for x in DELAYS),
    }
    return [panel(report, label, points) for label, points in cases.items()]


if __name__ == "__main__":
    with threadpool_limits(1):  # several threads are no faster here, and wait for each other
        main()
