# SPDX-License-Identifier: Apache-2.0

"""What is to be said of a taxel's reading."""

from __future__ import annotations

from enum import IntFlag


class Status(IntFlag):
    """Status bits of a taxel; the same as the constants of TactileArray.msg."""

    OK = 0
    SILENT = 1
    SATURATED = 2
    LOW_SNR = 4
    STALE = 8
    UNCALIBRATED = 16
    MASKED = 32
    WEAK = 64
    FAULTY = 128
