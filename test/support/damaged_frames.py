# SPDX-License-Identifier: Apache-2.0

"""Decoded frames with something false in them, for those who judge frames."""

from dataclasses import replace

import numpy as np

from tactile_cdma.driver.pipeline import TactileFrame


def with_words(frame: TactileFrame, **changes: object) -> TactileFrame:
    return replace(frame, words=replace(frame.words, **changes))  # type: ignore[arg-type]


def with_readings(frame: TactileFrame, **changes: object) -> TactileFrame:
    return replace(frame, readings=replace(frame.readings, **changes))  # type: ignore[arg-type]


def another_word(frame: TactileFrame) -> TactileFrame:
    """The first node that speaks says something else."""
    codes = frame.words.codes.copy()
    codes[np.flatnonzero(frame.words.active)[0]] ^= 1
    return with_words(frame, codes=codes)


def nobody(frame: TactileFrame) -> TactileFrame:
    return with_words(frame, active=np.zeros_like(frame.words.active))


def another_pressure(frame: TactileFrame) -> TactileFrame:
    return with_readings(frame, pressure_pa=frame.readings.pressure_pa + np.float32(90))
