# SPDX-License-Identifier: Apache-2.0

"""What the bytes of a few seconds say of the link, the line and every node. No I/O."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..base.errors import PortError
from ..base.listing import listed
from ..code.frame import UNIPOLAR
from ..config.skin_config import SkinConfig
from ..driver.checkup import CLIPPED_SHARE, decibels
from ..driver.pipeline import Pipeline, TactileFrame
from ..wire.messages import Status
from ..wire.packets import PacketParser
from ..words.decode import DOUBLE_SHARE, FAINT_SHARE, LOW_MARGIN, LOW_RHO
from ..words.health import MOST_DOUBLED, MOST_UNEVEN, WEAK_SHARE
from .report import Check, ok, problem, warning

SLOW = 0.95
"""Share of the expected rate below which frames are missed."""
OTHER_AMPLITUDE = 0.2
"""Relative difference of amplitudes that resistors of 5 % and their supply do not explain."""
MANY_BEYOND, FEW_BEYOND = 0.25, 0.02
"""Shares of all words: so many beyond the sensors' range, and so few of their opposites."""
STRAY_ERRORS = 1
"""The first bytes may be the rest of a packet, which counts as an error."""


@dataclass(frozen=True, slots=True)
class Stream:
    """What was heard. chunks: bytes and the host's monotonic time, s, when they were read.

    problem: why there are no frames.
    """

    chunks: list[tuple[bytes, float]]
    problem: str | None


@dataclass(frozen=True, slots=True)
class Heard:
    """The words of m frames of n nodes.

    arrived_s: (m,) float64, on the host's monotonic clock.
    active: (m, n) bool. codes: (m, n) int32. amplitude_v, rho: (m, n) float32.
    bad: (m, n) bool, words that contradict the code. doubled: (m, n) bool, of two nodes.
    """

    arrived_s: NDArray[np.float64]
    active: NDArray[np.bool_]
    codes: NDArray[np.int32]
    amplitude_v: NDArray[np.float32]
    rho: NDArray[np.float32]
    bad: NDArray[np.bool_]
    doubled: NDArray[np.bool_]


def judge(stream: Stream, config: SkinConfig) -> Iterator[Check]:
    """All that there is to say; amplitudes are measured before they are compared with config's.

    Raises PortError where bytes in which there were frames hold none after all.
    """
    yield from _link(stream)
    if stream.problem:
        yield problem("frames", stream.problem)
        return
    frames, heard = _heard(stream, config, None)
    yield from _rate(frames, heard, config)
    clipped = float(np.mean([frame.clipped for frame in frames]))
    yield from _range(clipped)
    if not heard.active.any():
        yield problem("nodes", "frames arrive, but no node speaks: is the skin powered?")
        return
    measured_v = _typical(heard)
    frames, heard = _heard(stream, config, measured_v)
    yield from _noise(frames, heard)
    if clipped < CLIPPED_SHARE:  # amplitudes are too small in what is clipped
        yield from _amplitude(measured_v, config)
    yield from _polarity(heard, config)
    yield from _nodes(heard, measured_v)


def _heard(
    stream: Stream, config: SkinConfig, swing_v: float | None
) -> tuple[list[TactileFrame], Heard]:
    """Decoded with this amplitude of a node's code; None: learnt from every frame.

    Raises PortError where that gives no frame.
    """
    threshold = config.threshold
    spec = replace(config.spec, amplitude_v=None)
    if swing_v is not None:
        unipolar = config.spec.drive == UNIPOLAR
        spec = replace(config.spec, amplitude_v=2 * swing_v if unipolar else swing_v)
        threshold = FAINT_SHARE  # weak nodes count as well: it is said of them that they are weak
    pipeline = Pipeline(replace(config, spec=spec, threshold=threshold), background=False)
    frames, arrived_s = [], []
    for data, t_host in stream.chunks:
        new = pipeline.feed(data, t_host)
        frames += new
        arrived_s += [t_host] * len(new)
    pipeline.close()
    if not frames:
        raise PortError(pipeline.problem or "no frame fits: check chip_us, order and bits")
    words = [frame.words for frame in frames]
    active = np.array([w.active & (w.rho > LOW_RHO) for w in words])
    return frames, Heard(
        arrived_s=np.array(arrived_s),
        active=active,
        codes=np.array([w.codes for w in words]),
        amplitude_v=np.array([w.amplitude_v for w in words]),
        rho=np.array([w.rho for w in words]),
        bad=active & np.array([w.doubtful & (w.margin < LOW_MARGIN) for w in words]),
        doubled=active & np.array([w.doubled for w in words]),
    )


def _typical(heard: Heard) -> float:
    """Amplitude of a node's code that half of the words exceed, V."""
    return float(np.median(heard.amplitude_v[heard.active]))


def _link(stream: Stream) -> Iterator[Check]:
    parser, reports = PacketParser(), []
    for data, _ in stream.chunks:
        reports += [packet for packet in parser.feed(data) if isinstance(packet, Status)]
    seen = parser.counters
    broken = seen.crc_errors + seen.framing_errors + seen.resyncs
    text = f"{seen.packets} packets, {broken} broken, {seen.lost_packets} lost"
    if broken > STRAY_ERRORS or seen.lost_packets:
        yield warning("link", f"{text}: check cable, ground and baud; use a port without a hub")
    elif seen.packets:
        yield ok("link", text)
    counts = [f.name for f in fields(Status) if f.name not in ("sequence", "uptime_us")]
    rising = [
        f"{name.replace('_', ' ')} {getattr(reports[-1], name) - getattr(reports[0], name):+}"
        for name in counts
        if reports and type(getattr(reports[0], name)) is int
        if getattr(reports[-1], name) > getattr(reports[0], name)
    ]
    if rising:
        yield warning(
            "digitizer's counts", f"{', '.join(rising)}: fewer samples_per_chip, or a better link"
        )


def _rate(frames: list[TactileFrame], heard: Heard, config: SkinConfig) -> Iterator[Check]:
    expected_hz = 1 / config.spec.frame_period_s
    if len(frames) < 2:
        yield warning("frames", f"one alone, there should be {expected_hz:.1f} per s")
        return
    span_s = heard.arrived_s[-1] - heard.arrived_s[0]
    rate_hz = (len(frames) - 1) / max(span_s, config.spec.frame_period_s)
    lost = frames[-1].sequence - frames[0].sequence + 1 - len(frames)
    text = f"{rate_hz:.1f} of {expected_hz:.1f} per s, {lost} lost"
    if lost or rate_hz < SLOW * expected_hz:
        yield warning("frames", f"{text}: is the link, or this computer, too slow for the samples?")
    else:
        yield ok("frames", text)


def _range(clipped: float) -> Iterator[Check]:
    if clipped:
        what = warning if clipped < CLIPPED_SHARE else problem
        yield what(
            "range",
            f"{clipped:.1%} of the samples at a rail of the digitizer: less gain "
            "(tactile-cdma amplifier), or row signs (sign_seed)",
        )


def _noise(frames: list[TactileFrame], heard: Heard) -> Iterator[Check]:
    noise_v = float(np.nanmedian([frame.words.noise_rms_v for frame in frames]))
    rho = np.where(heard.active, heard.rho, np.nan)[:, heard.active.any(axis=0)]
    weakest = float(np.nanmin(np.nanmedian(rho, axis=0)))
    text = f"{noise_v * 1e3:.2f} mV rms a chip, weakest node {decibels(weakest):.0f} dB"
    if weakest < 2 * LOW_RHO:
        yield warning("noise", f"{text}: look for what disturbs the line, or for that node's wire")
    else:
        yield ok("noise", text)


def _amplitude(measured_v: float, config: SkinConfig) -> Iterator[Check]:
    expected_v = config.spec.node_swing_v
    if expected_v is None:
        return
    stated_mv = (config.spec.amplitude_v or 0.0) * 1e3
    looks_mv = stated_mv * measured_v / expected_v
    ratio = measured_v / expected_v
    if abs(ratio - 1) <= OTHER_AMPLITUDE:
        yield ok("amplitude_mv", f"{stated_mv:g}, measured {looks_mv:.0f}")
        return
    unheard = not config.threshold < ratio < DOUBLE_SHARE
    consequence = ", so nodes are not heard or taken for two" if unheard else ""
    yield (problem if unheard else warning)(
        "amplitude_mv", f"looks like {looks_mv:.0f}, not {stated_mv:g}{consequence}: set it to that"
    )


def _polarity(heard: Heard, config: SkinConfig) -> Iterator[Check]:
    """Inverted, nodes at rest read beyond the sensors' range, and nothing reads as if at rest."""
    codes = heard.codes[heard.active]
    lowest = config.adc.code(config.curve.voltage_v[-1])
    beyond = float((codes < lowest).mean())
    opposite_beyond = float((2**config.spec.bits - 1 - codes < lowest).mean())
    if beyond > MANY_BEYOND and opposite_beyond < FEW_BEYOND:
        yield problem(
            "polarity",
            f"{beyond:.0%} of the words lie beyond the sensors' range and their opposites within: "
            f"set polarity to {-config.spec.polarity}, unless all taxels are pressed hard",
        )


def _nodes(heard: Heard, typical_v: float) -> Iterator[Check]:
    count = heard.active.sum(axis=0)
    spoke = count > 0
    amplitude_v = (heard.amplitude_v * heard.active).sum(axis=0) / np.maximum(count, 1)
    doubled = spoke & (
        (heard.doubled.sum(axis=0) > MOST_DOUBLED * count)
        | (amplitude_v > DOUBLE_SHARE * typical_v)
    )
    faulty = spoke & ~doubled & (heard.bad.sum(axis=0) > MOST_UNEVEN * count)
    weak = spoke & ~doubled & ~faulty & (amplitude_v < WEAK_SHARE * typical_v)
    total = f"{np.count_nonzero(spoke)} of {spoke.size} spoke"
    if not spoke.all():
        yield warning(
            "nodes",
            f"{total}, not heard: {_numbers(~spoke)}: are they connected and powered? (one that "
            "is at rest only speaks at its heartbeat: --seconds 10 listens longer)",
        )
    else:
        yield ok("nodes", total)
    if doubled.any():
        yield problem(
            "nodes",
            f"two speak on one code row: {_numbers(doubled)}: give every node its own number",
        )
    if faulty.any():
        yield problem(
            "nodes", f"words contradict the code: {_numbers(faulty)}: check their supply and clock"
        )
    if weak.any():
        yield warning("nodes", f"weaker than the others: {_numbers(weak)}: check their contacts")


def _numbers(mask: NDArray[np.bool_]) -> str:
    return listed((np.flatnonzero(mask) + 1).tolist(), "node")
