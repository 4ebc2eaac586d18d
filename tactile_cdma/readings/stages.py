# SPDX-License-Identifier: Apache-2.0

"""The stages from words to readings that pass over all nodes, and set their status."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats, Floats32
from ..words.decode import Words
from .status import Status

Bytes = NDArray[np.uint8]


_SILENT, _LOW_SNR, _SATURATED = (
    np.uint8(bit) for bit in (Status.SILENT, Status.LOW_SNR, Status.SATURATED)
)
_UNCALIBRATED, _FAULTY = np.uint8(Status.UNCALIBRATED), np.uint8(Status.FAULTY)


class Kept(NamedTuple):
    """What is kept of every node, (n,).

    codes: int32, its last word. flags: uint8, LOW_SNR where that is uncertain. heard_s: float64,
    device time of that word, s.
    """

    codes: NDArray[np.int32]
    flags: Bytes
    heard_s: Floats


class Trust(NamedTuple):
    """What is known of every node beside its words, (n,).

    state: uint8, status by its health. untrusted: bool, nodes whose words are no readings.
    """

    state: Bytes
    untrusted: Bools


class Bounds(NamedTuple):
    """Where the voltages of every node mean what they say, (n,) float32, V.

    Pressure pulls voltages down where sign is 1. There rest_v, where the curve begins, is the least
    that the highest code stands for, since that means "this or more". margin_v: by how much the
    lightest contact pulls a voltage down from there: one that lies higher above the rest is no
    reading, and a highest code that lies lower below it hides contacts. end_v: below it, a word may
    stand for a voltage beyond the end of the curve. Where sign is −1 all this is upside down.
    """

    sign: Floats32
    rest_v: Floats32
    margin_v: Floats32
    end_v: Floats32


class Heard(NamedTuple):
    """What words say of every node, (n,).

    voltage_v: float32, V. meant_v: the same, but rest_v for a code at the converter's end that may
    stand for it. status: uint8, bits of Status. valid: bool, whether that is a reading.
    stale_from_s: device time when the next node goes stale, s.
    """

    voltage_v: Floats32
    meant_v: Floats32
    status: Bytes
    valid: Bools
    stale_from_s: float


def hear(
    words: Words,
    kept: Kept,
    table_v: Floats32,
    trust: Trust,
    bounds: Bounds,
    now_s: float,
    stale_after_s: float,
) -> Heard:
    """Take in one frame's words; `kept` is updated. table_v: (codes,) V. now_s: device time, s."""
    codes, flags, heard_s = kept
    spoke = words.active
    np.copyto(codes, words.codes, where=spoke)
    np.copyto(heard_s, now_s, where=spoke)
    # A node that may have spoken unheard no longer holds its value for certain.
    np.copyto(flags, words.doubtful * _LOW_SNR, where=spoke | words.doubtful)
    voltage_v = table_v[codes]
    stale = now_s - heard_s > stale_after_s
    status = flags | ~spoke * _SILENT | trust.state
    status[stale] = Status.SILENT | Status.STALE
    stale_from_s = float(heard_s[~stale].min(initial=np.inf)) + stale_after_s
    at_end = codes == np.where(bounds.sign > 0, len(table_v) - 1, 0)
    pulled_v = bounds.sign * (bounds.rest_v - voltage_v)
    meant_v = np.where(at_end & (pulled_v > 0), bounds.rest_v, voltage_v)
    hiding = at_end & (pulled_v > bounds.margin_v)
    status |= (hiding & ~(stale | trust.untrusted)) * _SATURATED
    return Heard(voltage_v, meant_v, status, ~(stale | trust.untrusted), stale_from_s)


def convert(voltage_v: Floats32, pieces: Floats32) -> Floats32:
    """Pressures (n,) float32, Pa, clamped to each curve's ends, of voltages (n,) float32, V.

    pieces: see Curves. Every piece adds what of its width the voltage has passed, so no piece has
    to be looked up.
    """
    pressure_pa = np.zeros_like(voltage_v)
    for begin_v, gain, width_pa in pieces:
        passed_pa = begin_v - voltage_v
        passed_pa *= gain
        pressure_pa += np.clip(passed_pa, 0.0, width_pa, out=passed_pa)
    return pressure_pa


def finish(
    heard: Heard,
    saturated: Bools,
    off_rest: Bools,
    uncalibrated: Bools,
    masked: Bools,
    reading_pa: Floats32,
) -> None:
    """Complete heard.status, and make readings NaN that are none; reading_pa: (n,), Pa."""
    status, invalid = heard.status, ~heard.valid | off_rest
    status |= (saturated & heard.valid) * _SATURATED | (off_rest & heard.valid) * _FAULTY
    status |= uncalibrated * _UNCALIBRATED
    status[..., masked] = Status.MASKED
    reading_pa[invalid] = heard.voltage_v[invalid] = np.nan
