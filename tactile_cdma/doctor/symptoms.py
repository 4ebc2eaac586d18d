# SPDX-License-Identifier: Apache-2.0

"""Tells what a builder did wrong by what the line shows: wires, joints, sensors. No I/O."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from ..base.arrays import Bools, Floats, Floats32, Int32s
from ..base.text import listed
from ..code.encode import line_chips
from ..code.frame import UNIPOLAR, FrameSpec
from ..config.parameters import GAP, OWN
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline, TactileFrame
from ..wire._protocol import SYNC_LEAD, SYNC_UNIT_US
from ..wire.messages import Samples
from .report import Check, ok, warning

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
