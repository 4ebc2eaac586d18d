# SPDX-License-Identifier: Apache-2.0

"""Judges link, line, wires, joints and every node by the bytes of a few seconds. No I/O."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, TypeAlias

import numpy as np

from ..base.arrays import Bools, Floats, Floats32, Int32s
from ..base.errors import PortError
from ..base.text import listed
from ..code.encode import line_chips
from ..code.frame import UNIPOLAR, FrameSpec
from ..config.parameters import DATA, GAP, OWN
from ..config.skin_config import SkinConfig
from ..driver import checkup
from ..driver.digitizer import sync_trouble
from ..driver.pipeline import Pipeline, TactileFrame
from ..driver.scrambling import has_certain_word, mismatch
from ..driver.stream import Decisions
from ..driver.timeline import sample_count
from ..framing.frame_reader import hides_silence
from ..wire._protocol import SYNC_LEAD, SYNC_UNIT_US
from ..wire.messages import Info, Quiet, Samples, Status
from ..wire.packets import PacketParser
from ..words.health import DOUBLE_SHARE, FAINT_SHARE, NodeHealth, NodeState
from ..words.limits import LIMITS
from .report import Check, ok, problem, warning

WRONG_CLOCK = "One silent since power-up, whose LED blinks quickly: wrong clock?"
"""Firmware of nodes says so by its LED (docs/firmware.md)."""
FULL_RATE = 0.95
"""Share of the expected frame rate below which frames are missed. Chosen: in 3 s of 78 frames per
second the rate is known to 1 in 234."""
REST_OFF_V = 0.18
"""V that the line at rest may be off the middle of the converter's range: three times the 59 mV by
which parts of 1 % scatter it at 64 nodes (`make spice`)."""
RAIL_SHARE = 0.05
"""Share of the converter's range at either end, where a line at rest is at a rail. Chosen."""
MANY_BEYOND, FEW_BEYOND = 0.25, 0.02
"""Shares of all words. The line is taken to be inverted if more than MANY_BEYOND of them are beyond
the sensors' range, and fewer than FEW_BEYOND once they are inverted. Chosen."""
UNCLEAR_SHARE = 0.25
"""Share of frames without a clear word, yet in doubt, above which something is sent. Chosen: noise
alone has 0.1 of them, as long as no amplitude is known."""
STRAY_ERRORS = 1
"""Errors of a sound link: the first bytes may be the rest of a packet."""
OTHER_AMPLITUDE = 0.2
"""Relative difference of amplitudes that resistors of 5 % and their supply do not explain."""
MOST_OFF, OF_5_V = 0.05, 1.2
"""Distance of the middle of pins from the line's rest, relative; drops of like wires of supply and
ground cancel (make spice). A ground resets nodes at 1.12, so beyond they have 5 V."""
UNSTEADY, LEAST_WORDS = 0.3, 8
"""Distance of a node's loudest from its softest tenth of words, over its median, that noise and
load do not explain (0.2 at the weakest sound signal); words or frames that are needed. Chosen."""
END_SHARE = 0.01
"""Share of the range at the end that no pressed sensor reaches: 100 Ω at 3.3 kΩ is 3 %."""
MOST_CROSSTALK, STILL_THERE, SURE = 1.25, 0.1, 5.0
"""Level of a sync edge on the line, and just before a frame, over a node's: with ground between the
wires 0.14 (16 nodes) and 0.66 (64), loose 1.7 and 8.4 (make spice). Standard errors of no noise."""

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
    active: Bools
    untold: Bools
    pipeline: Pipeline


def judge(
    chunks: Chunks, config: SkinConfig, seconds: float, no_frames: str | None = None
) -> Iterator[Check]:
    """Run all checks of a stream; amplitudes are measured before they are compared with config's.

    seconds: how long it was to be listened to. no_frames: why there are none.
    Raises PortError where bytes in which there were frames hold none after all.
    """
    yield from _link(chunks, config)
    if no_frames:
        other = mismatch(config, chunks)
        yield problem("scramble", other) if other else problem("frames", no_frames)
        return
    decoded = _decoded(chunks, config, None)
    if not any(map(has_certain_word, decoded.frames)) and (other := mismatch(config, chunks)):
        yield problem("scramble", other)
        return
    yield from _rate(decoded, decoded.pipeline.config)
    if decoded.pipeline.has_source:
        yield from _nodes(decoded, seconds)
        return
    clipped = float(np.mean([frame.clipped for frame in decoded.frames]))
    if clipped:
        what = warning if clipped < checkup.CLIPPED_SHARE else problem
        yield what(
            "range",
            f"{clipped:.1%} of the samples at a rail of the digitizer: less gain "
            "(make amplifier), or row signs (sign_seed)",
        )
    if not decoded.active.any():
        words = [frame.words for frame in decoded.frames]
        unclear = sum(map(_may_hold_a_word, decoded.frames))
        text = f"frames arrive, but no node speaks: power, sync pulses? {WRONG_CLOCK}"
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
    if clipped < checkup.CLIPPED_SHARE:  # amplitudes are too small in what is clipped
        yield from _amplitude(measured_v, config)
    yield from _symptoms(decoded, chunks, measured_v, clipped)
    yield from _polarity(decoded, config)
    yield from _nodes(decoded, seconds)


def _symptoms(
    decoded: DecodedStream, chunks: Chunks, swing_v: float, clipped: float
) -> Iterator[Check]:
    active, frames, pipeline = decoded.active, decoded.frames, decoded.pipeline
    if pipeline.config.timing != GAP:
        yield ok("sync", f"{active.any(axis=0).sum()} spoke in step with the pulses")
    packets = chain.from_iterable(map(PacketParser().feed, (data for data, _ in chunks)))
    yield from wires(packets, pipeline, frames, swing_v)
    if clipped < checkup.CLIPPED_SHARE:
        volts = np.array([frame.words.amplitude_v for frame in frames])
        yield from loudness(volts, active, pipeline.health.nodes(NodeState.OK), swing_v)
    codes = np.array([frame.words.codes for frame in frames])
    yield from shorted(codes, active, pipeline.config)


def certified(decisions: Decisions) -> Check:
    """How many frames are in doubt, and why; see Certificate."""
    doubted = decisions.doubts.total()
    text = f"{doubted} of {decisions.frames} frames in doubt"
    if not doubted:
        return ok("certificate", text)
    text = f"{text} ({decisions.reasons})"
    if doubted <= checkup.DOUBTED_SHARE * decisions.frames:
        return ok("certificate", text)
    [(leading, _)] = decisions.doubts.most_common(1)
    return warning("certificate", f"{text}: {checkup.DOUBTED_FOR[leading]}")


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
        why = pipeline.problem or "no frame fits: check chip_us, order, bits and scramble"
        raise PortError(why)
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
            "the digitizer leaves out frames that differ by less than "
            f"{left_out_v * 1e3:.0f} mV, in which nodes may speak: give "
            "--params to examine all",
        )


def _link(chunks: Chunks, config: SkinConfig) -> Iterator[Check]:
    parser = PacketParser()
    reports: list[Status] = []
    latest: dict[type, Any] = {}
    total = size = 0  # sum of counts over the middle, to which words add nothing, and their number
    for packet in (packet for data, _ in chunks for packet in parser.feed(data)):
        latest[type(packet)] = packet
        if Info in latest and isinstance(packet, Samples | Quiet):
            counts = packet.sum if isinstance(packet, Quiet) else packet.counts.sum(dtype=np.int64)
            total += int(counts) - sample_count(packet) * latest[Info].zero_count
            size += sample_count(packet)
        if isinstance(packet, Status):
            reports.append(packet)
    seen = parser.counters
    broken = seen.crc_errors + seen.framing_errors + seen.resyncs
    text = f"{seen.packets} packets, {broken} broken, {seen.lost_packets} lost"
    if broken > STRAY_ERRORS or seen.lost_packets:
        yield warning("link", f"{text}: check cable, ground and baud; use a port without a hub")
    elif seen.packets:
        yield ok("link", text)
    # of a unipolar skin, and of row 0, words move the middle
    if size and config.spec.drive != UNIPOLAR and config.spec.first_row:
        yield from _rest(total / size * latest[Info].volts_per_count, latest[Info])
    if reports:
        rises = {name: getattr(reports[-1], name) - getattr(reports[0], name) for name in _FAULTS}
        info = latest.get(Info)
        trouble = sync_trouble(info, _level_v(info, latest)) if info else None
        if trouble and rises.pop("sync_faults") > 0:
            yield problem("sync", trouble)
        told = [f"{name.replace('_', ' ')} {rise:+}" for name, rise in rises.items() if rise > 0]
        if rising := ", ".join(told):
            text = f"{rising}: fewer samples_per_chip, or a better link"
            yield warning("digitizer's counts", text)


def _rest(level_v: float, info: Info) -> Iterator[Check]:
    """Check where the line rests, of a converter to whose middle it is biased."""
    range_v = (info.max_count - info.min_count + 1) * info.volts_per_count
    if 2 * info.zero_count != info.min_count + info.max_count + 1:
        return
    text = f"{range_v / 2 + level_v:.2f} V, should be {range_v / 2:.2f}"
    if abs(level_v) <= REST_OFF_V:
        yield ok("rest", text)
    elif abs(level_v) > (0.5 - RAIL_SHARE) * range_v:
        rail = "supply" if level_v > 0 else "ground"
        why = f"a short to {rail}, line and sync swapped, or an amplifier without supply"
        yield problem("rest", f"{text}: {why}")
    else:
        why = "one of the two equal resistors to supply and ground has another value or a bad joint"
        yield problem("rest", f"{text}: {why}")


def _level_v(info: Info, latest: dict[type, Any]) -> float:
    """Return the level of the line, V, by the latest packet of samples of any kind."""
    if (quiet := latest.get(Quiet)) is not None:
        return float((quiet.mean - info.zero_count) * info.volts_per_count)
    samples = latest.get(Samples)
    return float(np.median(info.volts(samples.counts))) if samples else math.nan


def _rate(decoded: DecodedStream, config: SkinConfig) -> Iterator[Check]:
    frames = decoded.frames
    expected_hz = 1 / config.spec.frame_period_s
    if len(frames) < 2:
        yield warning("frames", f"fewer than two arrived; {expected_hz:.1f} per s are expected")
        return
    # What waited before it was listened to arrives at once.
    arriving_s = decoded.arrived_s[1] - decoded.arrived_s[0]
    span_s = max(arriving_s, frames[-1].t_start - frames[0].t_start)
    rate_hz = (len(frames) - 1) / max(span_s, config.spec.frame_period_s)
    lost = frames[-1].sequence - frames[0].sequence + 1 - len(frames)
    text = f"{rate_hz:.1f} of {expected_hz:.1f} per s, {lost} lost"
    refused = decoded.pipeline.rejections
    if refused.total > checkup.REJECTED_SHARE * (refused.total + len(frames)):
        text = f"{text}; {refused.total} refused, mostly {checkup.REJECTED_FOR[refused.leading]}"
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
    text = f"{noise_v * 1e3:.2f} mV rms a chip, weakest node {checkup.decibels(weakest):.0f} dB"
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
    text = f"looks like {looks_mv:.0f}, not {stated_mv:g}{consequence}: set it to that"
    yield (problem if unheard else warning)("amplitude_mv", f"{text}, if supply, Rin, Rf are right")


def _polarity(decoded: DecodedStream, config: SkinConfig) -> Iterator[Check]:
    """Check the polarity: if inverted, nodes at rest read beyond the sensors' range.

    So they do where their voltage rises under load, and the curve falls. Where turning a word over
    changes its parity, that tells which; else a person has to.
    """
    codes = np.array([frame.words.codes for frame in decoded.frames])[decoded.active]
    spec, (rest_v, *_, end_v) = config.spec, config.curve.voltage_v
    end, turned, rises = config.adc.code(end_v), 2**config.spec.bits - 1 - codes, end_v > rest_v
    is_beyond = np.greater if rises else np.less
    beyond, opposite_beyond = (float(is_beyond(some, end).mean()) for some in (codes, turned))
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
            f"{beyond:.0%} of the words lie beyond the sensors' range, but inverted within it: "
            f"{remedies}",
        )


def _nodes(decoded: DecodedStream, seconds: float) -> Iterator[Check]:
    spoke = decoded.active.any(axis=0)
    total = f"{np.count_nonzero(spoke)} of {spoke.size} spoke"
    if decoded.pipeline.config.sync_wire == DATA:
        total += ", in step with pulses on the data wire"
    if spoke.all():
        yield ok("nodes", total)
    else:
        silent = listed((np.flatnonzero(~spoke) + 1).tolist(), "node")
        why = (
            f"are they connected and powered, do they get sync pulses? {WRONG_CLOCK} (one at rest "
            f"only speaks at its heartbeat: --seconds {2 * seconds:g} listens longer)"
        )
        if decoded.untold[~spoke].all():
            why = "whether they spoke cannot be told on this line"
        if twice := decoded.pipeline.health.nodes(NodeState.DOUBLED):
            why = f"was one flashed with the number of {listed(twice, 'node')}? Else: {why}"
        yield warning("nodes", f"{total}, not heard: {silent}: {why}")
    for state, text in checkup.UNSOUND.items():
        if numbers := decoded.pipeline.health.nodes(state):
            what = warning if state == NodeState.WEAK else problem
            yield what("nodes", text.format(listed(numbers, "node")))


def loudness(volts: Floats32, active: Bools, nodes: list[int], swing_v: float) -> Iterator[Check]:
    """Check nodes against the skin's, and each one's words. volts: (m, n) of m frames."""
    for number in nodes:
        own = volts[active[:, number - 1], number - 1]
        low_v, middle_v, high_v = np.percentile(own, (10, 50, 90)) if own.size else (swing_v,) * 3
        ratio = middle_v / swing_v
        if own.size >= LEAST_WORDS and high_v - low_v > UNSTEADY * middle_v:
            text = f"node {number} comes and goes, {low_v * 1e3:.0f} to {high_v * 1e3:.0f} mV"
            yield warning("joint", f"{text}: a cold joint, at its resistor to the line or supply")
        elif abs(ratio - 1) > OTHER_AMPLITUDE:
            why = "too small" if ratio > 1 else "too large, or a joint of its wire is bad"
            text = f"node {number} is {ratio:.2f} times as loud as the others: its resistor is"
            yield warning("loudness", f"{text} {why}")


def shorted(codes: Int32s, active: Bools, config: SkinConfig) -> Iterator[Check]:
    """Check for nodes whose sensor is at the end that no pressed sensor reaches."""
    rest_v, *_, end_v = config.curve.voltage_v
    top, at = 2**config.spec.bits - 1, "supply" if end_v > rest_v else "ground"
    beyond = codes > (1 - END_SHARE) * top if end_v > rest_v else codes < END_SHARE * top
    always = active.any(axis=0) & ~(active & ~beyond).any(axis=0)
    if always.any() and (active & ~beyond).any():
        names = listed((np.flatnonzero(always) + 1).tolist(), "node")
        why = f"sensor and its resistor swapped, or a bridge from the sensor's pin to {at}"
        yield warning("sensors", f"at {at} in every word, as none that is pressed: {names}: {why}")


def wires(
    packets: Iterable[object], pipeline: Pipeline, frames: list[TactileFrame], swing_v: float
) -> Iterator[Check]:
    """Check what supply and sync wire do to the line; swing_v: level of a node."""
    config, spec, info = pipeline.config, pipeline.config.spec, pipeline.digitizer.info
    if info is None or info.integrated or config.timing == GAP:
        return
    period, used = (round(s * info.sample_rate_hz) for s in (spec.frame_period_s, spec.frame_s))
    wide = math.ceil(SYNC_LEAD * SYNC_UNIT_US * 1e-6 * info.sample_rate_hz) + 1
    begun: list[tuple[float, list[Floats32]]] = []
    for packet in packets:
        if isinstance(packet, Samples) and packet.sync:
            begun.append((packet.device_time_us * 1e-6, []))
        if isinstance(packet, Samples) and begun:
            begun[-1][1].append(info.volts(packet.counts))
    whole = {at_s: v for at_s, own in begun if (v := np.concatenate(own)).size == period}
    if len(whole) < LEAST_WORDS or period - used < 4 * wide:
        return
    starts_s, volts = np.array([*whole]), np.array([*whole.values()], np.float64)
    if spec.drive != UNIPOLAR and spec.span_chips == spec.chips:
        moved_v = volts[:, :used].mean(axis=1) - np.median(volts[:, used + wide : -wide], axis=1)
        yield from _supply(starts_s, moved_v, spec, frames, swing_v)
    if config.sync_wire == OWN:
        yield from _crosstalk(volts[:, -3 * wide : -wide], volts[:, -wide:], swing_v)


def _supply(
    starts_s: Floats, moved_v: Floats, spec: FrameSpec, frames: list[TactileFrame], swing_v: float
) -> Iterator[Check]:
    """Check the middle of pins' levels: the line moves by it while they are driven."""
    off = []
    for frame in frames:
        words, half_s = frame.words, spec.frame_period_s / 2
        at = min(int(np.searchsorted(starts_s, frame.t_start - half_s)), starts_s.size - 1)
        if abs(starts_s[at] - frame.t_start) < half_s and words.active.any():
            sent_v = line_chips(spec, words.codes, words.active, swing_v).mean()
            off.append((moved_v[at] - sent_v) / (swing_v * words.active.sum()))
    share = 1 + spec.polarity * float(np.median(off or [0.0]))
    text = f"the middle of nodes' pins is at {share:.1%} of the line's rest"
    why = "low, or a bad joint of it" if share < 1 else "a bad joint of ground, or some of 5 V"
    sound = abs(share - 1) <= MOST_OFF or share > OF_5_V
    yield ok("supply", text) if sound else warning("supply", f"{text}: {why}")


def _crosstalk(before: Floats, pulse: Floats, swing_v: float) -> Iterator[Check]:
    """Check what is left of sync pulses when frames' ends, (m, …) V, are laid over each other."""
    moved_v = np.abs((pulse - np.median(before)).mean(axis=0))
    noise_v = SURE * float(before.std()) / math.sqrt(len(before))
    text = f"sync edges move the line by {moved_v.max() * 1e3:.1f} mV"
    if late := moved_v[-1] > STILL_THERE * swing_v + noise_v:
        text += f", and by {moved_v[-1] * 1e3:.1f} still when the frame begins"
    if late or moved_v.max() > MOST_CROSSTALK * swing_v + noise_v:
        yield warning("crosstalk", f"{text}: lay a ground wire between sync and line")
    else:
        yield ok("crosstalk", text)
