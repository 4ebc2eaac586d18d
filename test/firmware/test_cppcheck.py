# SPDX-License-Identifier: Apache-2.0

"""cppcheck finds nothing in the firmware."""

from __future__ import annotations

import pytest
from conftest import CORE, FIRMWARE, need, run

CHECKS = ("--enable=warning,performance,portability", "--error-exitcode=1", "--std=c11", "--quiet")
IGNORED = (
    "--suppress=missingIncludeSystem",
    "--suppress=comparePointers:*/start.c",  # a section's begin and end, named by the linker
)
NODE = FIRMWARE / "node"
AVR = (
    "-DCRC32_SMALL",
    "-DEMPTY_INTERRUPT(vector)=void vector(void) {}",
    "-DATOMIC_BLOCK(state)=",
    CORE,
    NODE,
)
"""Definitions and headers of a node's build, and avr-libc's macros that cppcheck cannot parse."""


@pytest.mark.parametrize(
    "sources",
    [
        ("-i", FIRMWARE / "build", "-i", NODE, FIRMWARE),
        ("-D__AVR_ATmega328P__", "-i", NODE / "attiny85.c", *AVR),
        ("-D__AVR_ATtiny85__", "-i", NODE / "atmega328p.c", *AVR),
    ],
    ids=["digitizer", "atmega328p", "attiny85"],
)
def test_cppcheck_is_content(sources: tuple[str, ...]) -> None:
    run(need("cppcheck"), *CHECKS, *IGNORED, "-I", CORE, *sources)
