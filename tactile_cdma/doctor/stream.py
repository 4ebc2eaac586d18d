# SPDX-License-Identifier: Apache-2.0

"""Judges the link, the line and every node by the bytes of a few seconds. No I/O."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..base.errors import PortError
from ..base.text import listed
from ..code.frame import UNIPOLAR
from ..config.skin_config import SkinConfig
from ..driver.checkup import (
    CLIPPED_SHARE,
    DOUBTED_FOR,
    DOUBTED_SHARE,
    REJECTED_FOR,
    REJECTED_SHARE,
    UNSOUND,
    decibels,
)
from ..driver.pipeline import Pipeline, TactileFrame
from ..driver.scrambling import is_understood, mismatch
from ..driver.stream import Decisions
from ..framing.frame_reader import hides_silence
from ..wire.messages import Status
from ..wire.packets import PacketParser
from ..words.health import DOUBLE_SHARE, FAINT_SHARE, NodeHealth, NodeState
from ..words.limits import LIMITS
from .report import Check, ok, problem, warning

WRONG_CLOCK = "One silent since power-up, whose LED blinks quickly: wrong clock?"
"""Firmware of nodes says so by its LED (docs/firmware.md)."""
FULL_RATE = 0.95
"""Share of the expected frame rate below which frames are missed. Chosen: in 3 s of 78 frames per
second the rate is known to 1 in 234."""
OTHER_AMPLITUDE = 0.2
"""Relative difference of amplitudes that resistors of 5 % and their supply do not explain."""
MANY_BEYOND, FEW_BEYOND = 0.25, 0.02
"""Shares of all words. The line is taken to be inverted if more than MANY_BEYOND of them are beyond
the sensors' range, and fewer than FEW_BEYOND once they are inverted. Chosen."""
UNCLEAR_SHARE = 0.25
"""Share of frames without a clear word, yet in doubt, above which something is sent. Chosen: noise
alone has 0.1 of them, as long as no amplitude is known."""
STRAY_ERRORS = 1
"""Errors of a sound link: the first bytes may be the rest of a packet."""

Chunks: TypeAlias = list[tuple[bytes, float]]
"""Bytes, and the host's monotonic time, s, when they were read."""
_FAULTS = ("samples_lost", "packets_dropped", "commands_refused", "command_errors", "sync_faults")
"""Counts of a digitizer's STATUS that do not rise on a sound one."""


@dataclass(frozen=True, slots=True)
class DecodedStream:
    """m frames of n nodes, and the pipeline that gave them, with its verdict on the nodes.

    arrived_s: when the first and the last one came, on the host's monotonic clock. active: (m, n)
    bool, words that stand out of the noise; what may be the line's level is none. untold: (n,)
    bool, nodes of which no frame tells for certain whether they spoke.
    """

    frames: list[TactileFrame]
    arrived_s: tuple[float, float]
    active: NDArray[np.bool_]
    untold: NDArray[np.bool_]
    pipeline: Pipeline


def judge(
    chunks: Chunks, config: SkinConfig, seconds: float, no_frames: str | None = None
) -> Iterator[Check]:
    """Run all checks of a stream; amplitudes are measured before they are compared with config's.

    seconds: how long it was to be listened to. no_frames: why there are none.
    Raises PortError where bytes in which there were frames hold none after all.
    """
    yield from _link(chunks)
    if no_frames:
        other = mismatch(config, chunks)
        yield problem("scramble", other) if other else problem("frames", no_frames)
        return
    decoded = _decoded(chunks, config, None)
    if not any(map(is_understood, decoded.frames)) and (other := mismatch(config, chunks)):
        yield problem("scramble", other)
        return
    yield from _rate(decoded, decoded.pipeline.config)
    if decoded.pipeline.has_source:
        yield from _nodes(decoded, seconds)
        return
    clipped = float(np.mean([frame.clipped for frame in decoded.frames]))
    if clipped:
        what = warning if clipped < CLIPPED_SHARE else problem
        yield what(
            "range",
            f"{clipped:.1%} of the samples at a rail of the digitizer: less gain "
            "(make amplifier), or row signs (sign_seed)",
        )
    if not decoded.active.any():
        words = [frame.words for frame in decoded.frames]
        unclear = sum(map(_may_hold_a_word, decoded.frames))
        text = f"frames arrive, but no node speaks: is the skin powered? {WRONG_CLOCK}"
        if unclear:  # by chance, as long as no amplitude is known
            text += f" {unclear} of {len(words)} frames may hold a word."
        noise_v = float(np.nanmedian([each.noise_rms_v for each in words]))
        if unclear > UNCLEAR_SHARE * len(words) or hides_silence(clipped, noise_v, config.spec):
            text = "something is sent, but no word is clear: who spoke cannot be told on this line"
        yield problem("nodes", text)
        yield from _left_out(decoded, 0.0)
        return
    amplitude_v = np.array([frame.words.amplitude_v for frame in decoded.frames])
    measured_v = float(np.median(amplitude_v[decoded.active]))
    decoded = _decoded(chunks, config, measured_v)
    yield from _left_out(decoded, measured_v)
    yield from _noise(decoded)
    if clipped < CLIPPED_SHARE:  # amplitudes are too small in what is clipped
        yield from _amplitude(measured_v, config)
    yield from _polarity(decoded, config)
    yield from _nodes(decoded, seconds)


def certified(decisions: Decisions) -> Check:
    """How many frames are in doubt, and why; see Certificate."""
    doubted = decisions.doubts.total()
    text = f"{doubted} of {decisions.frames} frames in doubt"
    if not doubted:
        return ok("certificate", text)
    text = f"{text} ({decisions.reasons})"
    if doubted <= DOUBTED_SHARE * decisions.frames:
        return ok("certificate", text)
    [(leading, _)] = decisions.doubts.most_common(1)
    return warning("certificate", f"{text}: {DOUBTED_FOR[leading]}")


def _may_hold_a_word(frame: TactileFrame) -> bool:
    """Whether a word shows; means of chips are silent in doubt until the first word, and hold."""
    doubtful, certificate = frame.words.doubtful, frame.certificate
    untimed = certificate is not None and certificate.holds and doubtful.all()
    return bool(frame.words.active.any() or (doubtful.any() and not untimed))


def _decoded(chunks: Chunks, config: SkinConfig, swing_v: float | None) -> DecodedStream:
    """Decode with this amplitude of a node's code; None: learnt from every frame.

    From one value per chip, silence can't be told without an amplitude: there it is the stated one.
    Raises PortError where that gives no frame.
    """
    spec = config.spec
    if config.samples_per_chip > 1:
        spec = replace(spec, amplitude_v=None)
    # Weak nodes count as heard once the amplitude is known, and are told to be weak.
    active_share = config.active_share if swing_v is None else FAINT_SHARE
    pipeline = Pipeline(replace(config, spec=spec, active_share=active_share))
    if swing_v is not None:
        # Frames are read by it, though the configuration has none: what the digitizer leaves out
        # was set by another one, and a pipeline refuses a stream that does not fit its own.
        unipolar = config.spec.drive == UNIPOLAR
        measured = replace(spec, amplitude_v=2 * swing_v if unipolar else swing_v)
        pipeline.health = NodeHealth(measured)
    frames, arrived_s = [], []
    for data, t_host in chunks:
        if new := pipeline.feed(data, t_host):
            frames += new
            arrived_s.append(t_host)
    if not frames:
        raise PortError(
            pipeline.problem or "no frame fits: check chip_us, order, bits and scramble"
        )
    pipeline.health.judge(least_words=1)  # a node at rest speaks once a second only
    active = np.array([frame.words.active & (frame.words.rho > LIMITS.low_rho) for frame in frames])
    doubtful = np.array([frame.words.doubtful for frame in frames])
    if config.spec.first_row == 0 and config.samples_per_chip == 1:
        active[:, 0] &= ~doubtful[:, 0]
    untold = np.asarray(doubtful.all(axis=0))
    return DecodedStream(frames, (arrived_s[0], arrived_s[-1]), active, untold, pipeline)


def _left_out(decoded: DecodedStream, swing_v: float) -> Iterator[Check]:
    """Check whether words of this amplitude, V, may be among the samples that are left out.

    A word turns by twice its amplitude.
    """
    info = decoded.pipeline.digitizer.info
    left_out_v = info.quiet_uv * 1e-6 if info else 0.0
    if left_out_v > 2 * decoded.pipeline.config.active_share * swing_v:
        yield warning(
            "quiet",
            "the digitizer leaves out what differs by less than "
            f"{left_out_v * 1e3:.0f} mV, in which nodes may speak: name "
            "the parameters (--params) to examine all",
        )


def _link(chunks: Chunks) -> Iterator[Check]:
    parser, reports = PacketParser(), []
    for data, _ in chunks:
        reports += [packet for packet in parser.feed(data) if isinstance(packet, Status)]
    seen = parser.counters
    broken = seen.crc_errors + seen.framing_errors + seen.resyncs
    text = f"{seen.packets} packets, {broken} broken, {seen.lost_packets} lost"
    if broken > STRAY_ERRORS or seen.lost_packets:
        yield warning("link", f"{text}: check cable, ground and baud; use a port without a hub")
    elif seen.packets:
        yield ok("link", text)
    if reports:
        rises = {name: getattr(reports[-1], name) - getattr(reports[0], name) for name in _FAULTS}
        told = [f"{name.replace('_', ' ')} {rise:+}" for name, rise in rises.items() if rise > 0]
        if rising := ", ".join(told):
            yield warning(
                "digitizer's counts", f"{rising}: fewer samples_per_chip, or a better link"
            )


def _rate(decoded: DecodedStream, config: SkinConfig) -> Iterator[Check]:
    frames = decoded.frames
    expected_hz = 1 / config.spec.frame_period_s
    if len(frames) < 2:
        yield warning("frames", f"one alone, there should be {expected_hz:.1f} per s")
        return
    # What waited before it was listened to arrives at once.
    arriving_s = decoded.arrived_s[1] - decoded.arrived_s[0]
    span_s = max(arriving_s, frames[-1].t_start - frames[0].t_start)
    rate_hz = (len(frames) - 1) / max(span_s, config.spec.frame_period_s)
    lost = frames[-1].sequence - frames[0].sequence + 1 - len(frames)
    text = f"{rate_hz:.1f} of {expected_hz:.1f} per s, {lost} lost"
    refused = decoded.pipeline.rejections
    if refused.total > REJECTED_SHARE * (refused.total + len(frames)):
        text = f"{text}; {refused.total} refused, mostly {REJECTED_FOR[refused.leading]}"
        yield warning("frames", text)
    elif lost or rate_hz < FULL_RATE * expected_hz:
        yield warning("frames", f"{text}: is the link, or this computer, too slow for the samples?")
    else:
        yield ok("frames", text)


def _noise(decoded: DecodedStream) -> Iterator[Check]:
    noise_v = float(np.nanmedian([frame.words.noise_rms_v for frame in decoded.frames]))
    rho = np.where(decoded.active, [frame.words.rho for frame in decoded.frames], np.nan)
    rho = rho[:, decoded.active.any(axis=0)]
    weakest = float(np.nanmin(np.nanmedian(rho, axis=0)))
    text = f"{noise_v * 1e3:.2f} mV rms a chip, weakest node {decibels(weakest):.0f} dB"
    if weakest < 2 * LIMITS.low_rho:
        yield warning("noise", f"{text}: look for what disturbs the line, or for that node's wire")
    else:
        yield ok("noise", text)


def _amplitude(measured_v: float, config: SkinConfig) -> Iterator[Check]:
    expected_v = config.spec.node_swing_v
    if expected_v is None:
        return
    stated_mv = (config.spec.amplitude_v or 0.0) * 1e3
    ratio = measured_v / expected_v
    looks_mv = stated_mv * ratio
    if abs(ratio - 1) <= OTHER_AMPLITUDE:
        yield ok("amplitude_mv", f"{stated_mv:g}, measured {looks_mv:.0f}")
        return
    unheard = not config.active_share < ratio < DOUBLE_SHARE
    consequence = ", so nodes are not heard or taken for two" if unheard else ""
    yield (problem if unheard else warning)(
        "amplitude_mv", f"looks like {looks_mv:.0f}, not {stated_mv:g}{consequence}: set it to that"
    )


def _polarity(decoded: DecodedStream, config: SkinConfig) -> Iterator[Check]:
    """Check the polarity: if inverted, nodes at rest read beyond the sensors' range.

    So they do where their voltage rises under load, and the curve falls. Where turning a word over
    changes its parity, that tells which; else a person has to.
    """
    codes = np.array([frame.words.codes for frame in decoded.frames])[decoded.active]
    spec, (rest_v, *_, end_v) = config.spec, config.curve.voltage_v
    end, turned, rises = config.adc.code(end_v), 2**config.spec.bits - 1 - codes, end_v > rest_v
    beyond, opposite_beyond = (
        float((some > end if rises else some < end).mean()) for some in (codes, turned)
    )
    if beyond > MANY_BEYOND and opposite_beyond < FEW_BEYOND:
        turn = f"set polarity to {-spec.polarity}, unless all taxels are pressed hard"
        bend = (
            f"where their voltage {'falls' if rises else 'rises'} under load, set v0_v to that "
            f"at rest, and {'positive' if rises else 'negative'} sensitivities "
            "(sensitivity1_v_per_kpa, sensitivity2_v_per_kpa)"
        )
        remedies = f"{bend}; else {turn}"
        if spec.parity and spec.line_bits % 2:
            odd = np.array([frame.words.odd for frame in decoded.frames])[decoded.active]
            remedies = turn if odd.mean() > MANY_BEYOND else bend
        yield problem(
            "polarity",
            f"{beyond:.0%} of the words lie beyond the sensors' range and their opposites within: "
            f"{remedies}",
        )


def _nodes(decoded: DecodedStream, seconds: float) -> Iterator[Check]:
    spoke = decoded.active.any(axis=0)
    total = f"{np.count_nonzero(spoke)} of {spoke.size} spoke"
    if spoke.all():
        yield ok("nodes", total)
    else:
        silent = listed((np.flatnonzero(~spoke) + 1).tolist(), "node")
        why = (
            f"are they connected and powered? {WRONG_CLOCK} (one at rest only speaks at its "
            f"heartbeat: --seconds {2 * seconds:g} listens longer)"
        )
        if decoded.untold[~spoke].all():
            why = "whether they spoke cannot be told on this line"
        yield warning("nodes", f"{total}, not heard: {silent}: {why}")
    for state, text in UNSOUND.items():
        if numbers := decoded.pipeline.health.nodes(state):
            what = warning if state == NodeState.WEAK else problem
            yield what("nodes", text.format(listed(numbers, "node")))
