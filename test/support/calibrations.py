# SPDX-License-Identifier: Apache-2.0

"""Calibration files of any curves."""

from pathlib import Path

from tactile_cdma.readings.calibration import AdcScale, Calibration
from tactile_cdma.readings.calibration_file import CalibrationContent, write_content


def write_calibration(
    path: Path, calibration: Calibration, adc: AdcScale, skin: str = "", source: str = ""
) -> str:
    """Write a calibration; returns its identity."""
    return write_content(path, CalibrationContent.of(calibration, adc, skin, source))
