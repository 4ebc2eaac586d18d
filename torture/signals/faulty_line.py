# SPDX-License-Identifier: Apache-2.0

"""Faults of the analog line between the nodes and the converter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Level = NDArray[np.float32]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Span:
    """Samples of one frame period, and random generators for them.

    volts: (m,) V. t_s: (m,) s since the disturbance began. frame_s: length of the frame in it.
    unit_v: level of one node. peak_v: 4·√n nodes, which nearly all sums stay below.
    life: seeded once for each disturbance; chance: anew for every frame.
    """

    volts: Level
    t_s: Floats
    frame_s: float
    unit_v: float
    peak_v: float
    life: np.random.Generator
    chance: np.random.Generator

    def moment(self, rng: np.random.Generator) -> float:
        """A random instant within the frame, s."""
        return float(self.t_s[0] + rng.uniform(0, self.frame_s))


Broken = Callable[[Span], Level]
"""Returns the line's volts with the fault."""


def hum(frequency_hz: float, nodes: float) -> Broken:
    """Mains hum with odd harmonics; its amplitude in levels of a node."""

    def added(line: Span) -> Level:
        phase = 2 * np.pi * (frequency_hz * line.t_s + line.life.random())
        wave = sum(np.sin(order * phase) / order**2 for order in (1, 3, 5, 7))
        return _with(line, nodes * line.unit_v * np.asarray(wave))

    return added


def motor(nodes: float) -> Broken:
    """A burst of a PWM drive's switching, 16 kHz and its ringing, a few ms long."""

    def added(line: Span) -> Level:
        begin_s, length_s = line.moment(line.chance), line.chance.uniform(0.5e-3, 4e-3)
        on = (line.t_s >= begin_s) & (line.t_s < begin_s + length_s)
        since_s = np.mod(line.t_s + line.life.uniform(0, 1 / 16e3), 1 / 16e3)
        ringing = np.exp(-since_s / 8e-6) * np.cos(2 * np.pi * 180e3 * since_s)
        noise = line.chance.standard_normal(line.t_s.size) * 0.3
        return _with(line, nodes * line.unit_v * on * (ringing + noise))

    return added


def discharge(line: Span) -> Level:
    """An ESD spike of 5 to 500 nodes that fades within 1 to 300 µs."""
    at_s, fade_s = line.moment(line.chance), 10 ** line.chance.uniform(-6, -3.5)
    height = line.chance.choice([-1, 1]) * 10 ** line.chance.uniform(0.7, 2.7) * line.unit_v
    since_s = line.t_s - at_s
    return _with(line, np.where(since_s >= 0, height * np.exp(-np.maximum(since_s, 0) / fade_s), 0))


def wander(line: Span) -> Level:
    """A baseline that swings by ten nodes with a period of two seconds."""
    return _with(line, 10 * line.unit_v * np.sin(2 * np.pi * (line.t_s / 2 + line.life.random())))


def jump(nodes: float) -> Broken:
    """A baseline that jumps by up to this many nodes within a frame, and decays within 30 ms."""

    def added(line: Span) -> Level:
        at_s = line.life.uniform(0, line.frame_s)
        height, since_s = nodes * line.unit_v * line.life.uniform(-1, 1), line.t_s - at_s
        fading = np.exp(-np.maximum(since_s, 0) / 0.03)
        return _with(line, np.where(since_s >= 0, height * fading, 0))

    return added


def hard_clipping(share: float) -> Broken:
    """An amplifier's rails at a share of the largest likely sum."""
    return lambda line: np.clip(line.volts, -share * line.peak_v, share * line.peak_v)


def soft_clipping(share: float) -> Broken:
    """An amplifier that saturates softly from this share of the largest likely sum on."""

    def tired(line: Span) -> Level:
        limit_v = np.float32(share * line.peak_v)
        return np.asarray(limit_v * np.tanh(line.volts / limit_v), dtype=np.float32)

    return tired


def gain_step(line: Span) -> Level:
    """A gain that changes to 0.7 … 1.5 within the first frame and stays for a while."""
    at_s, gain = line.life.uniform(0, line.frame_s), line.life.uniform(0.7, 1.5)
    return np.where(line.t_s < at_s, line.volts, np.float32(gain) * line.volts)


def dip(line: Span) -> Level:
    """A supply that sags to between nothing and 0.9 for 1 to 6 ms."""
    begin_s, length_s = line.moment(line.chance), line.chance.uniform(1e-3, 6e-3)
    on = (line.t_s >= begin_s) & (line.t_s < begin_s + length_s)
    return np.where(on, np.float32(line.chance.uniform(0, 0.9)) * line.volts, line.volts)


def at_rail(line: Span) -> Level:
    """A wire that touches the supply."""
    return np.full_like(line.volts, 1e3)


def pulled_low(line: Span) -> Level:
    """A transistor that stays on: the line lies five nodes below its rest, and moves no more."""
    return np.full_like(line.volts, -0.5 * line.peak_v)


def second_digitizer(line: Span) -> Level:
    """Another one pulls the line low for its own frames, 32 µs each time, 1 % more often."""
    period_s = 0.99 * (line.t_s[-1] - line.t_s[0])
    since_s = np.mod(line.t_s + line.life.random() * period_s, period_s)
    return _pulled(line, since_s)


def pulse_seen(line: Span) -> Level:
    """The digitizer's own pulse, 64 µs before the next frame, whose samples it does not hold."""
    return _pulled(line, line.t_s - (line.t_s[-1] - 64e-6))


def _pulled(line: Span, since_s: Floats) -> Level:
    """The line, pulled low for 32 µs, and back at rest some µs after, by `make spice SYNC=data`."""
    low_v = np.float32(-line.peak_v)
    fading = np.exp(-np.maximum(since_s - 32e-6, 0) / 1.3e-6)
    return np.where(since_s >= 0, line.volts + (low_v - line.volts) * fading, line.volts).astype(
        "f4"
    )


def torn_off(line: Span) -> Level:
    """An open wire, which picks up mains and noise."""
    phase = 2 * np.pi * (50 * line.t_s + line.life.random())
    noise = line.chance.standard_normal(line.t_s.size)
    return (line.unit_v * (0.05 * np.sin(phase) + 0.02 * noise)).astype(np.float32)


def shorted(line: Span) -> Level:
    """A wire that touches ground."""
    return np.zeros_like(line.volts)


def loose(line: Span) -> Level:
    """A wire that makes contact now and then within a frame."""
    contact = line.chance.random(1 + line.t_s.size // 50) < 0.5
    return line.volts * np.repeat(contact, 50)[: line.t_s.size].astype(np.float32)


def oscillating(line: Span) -> Level:
    """An amplifier that oscillates, at 100 Hz to 100 kHz."""
    frequency_hz = 10 ** line.life.uniform(2, 5)
    phase = 2 * np.pi * (frequency_hz * line.t_s + line.life.random())
    return _with(line, 8 * line.unit_v * np.sin(phase))


def warming(line: Span) -> Level:
    """A gain and an offset that drift by 20 % and ten nodes with a period of 8 s."""
    course = np.sin(2 * np.pi * (line.t_s / 8 + line.life.random()))
    return (line.volts * (1 + 0.2 * course) + 10 * line.unit_v * course).astype(np.float32)


def in_turn(*faults: Broken) -> Broken:
    """Several faults on the same line, in this order."""

    def all_of_them(line: Span) -> Level:
        for fault in faults:
            line = replace(line, volts=fault(line))
        return line.volts

    return all_of_them


def _with(line: Span, more: Floats) -> Level:
    return line.volts + more.astype(np.float32)
