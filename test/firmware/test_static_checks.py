# SPDX-License-Identifier: Apache-2.0

"""Checks that run no firmware: core/ depends on no board, cppcheck finds nothing, and fuses.

The fuse bytes in firmware/README.md match the fuses named there.
"""

import re
from pathlib import Path

import pytest

from test.support.firmware import CORE, FIRMWARE, STRICT, need, run

SYSTEM = {"stdbool.h", "stddef.h", "stdint.h", "string.h"}
"""All that core/ takes from a C library; of string.h, memcpy, memmove and memset."""


@pytest.mark.parametrize("source", sorted(CORE.glob("*.[ch]")), ids=lambda path: path.name)
def test_a_core_file_includes_only_core_files(source: Path, tmp_path: Path) -> None:
    includes = [
        line.split()[1] for line in source.read_text().splitlines() if line.startswith("#include")
    ]
    assert {name.strip("<>") for name in includes if name.startswith("<")} <= SYSTEM
    used = run(need("cc"), *STRICT, "-MM", source, cwd=tmp_path).replace("\\\n", " ").split()[1:]
    assert used and {Path(name).resolve().parent for name in used} == {CORE}


CHECKS = ("--enable=warning,performance,portability", "--error-exitcode=1", "--std=c11", "--quiet")
IGNORED = (
    "--suppress=missingIncludeSystem",
    "--suppress=comparePointers:*/start.c",  # a section's begin and end, named by the linker
    # Found by newer ones only. What allocates are the emulators and fuzzers, which may crash then.
    "--suppress=normalCheckLevelMaxBranches",
    "--suppress=nullPointerOutOfMemory",
    "--suppress=nullPointerArithmeticOutOfMemory",
)
NODE = FIRMWARE / "node"
COUNTER = FIRMWARE / "digitizer" / "replay" / "mps2.c"
"""Defines for ARM what is a macro elsewhere."""
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
        ("-i", FIRMWARE / "build", "-i", NODE, "-i", COUNTER, FIRMWARE),
        ("-D__AVR_ATmega328P__", "-i", NODE / "attiny85.c", *AVR),
        ("-D__AVR_ATtiny85__", "-i", NODE / "atmega328p.c", *AVR),
    ],
    ids=["digitizer", "atmega328p", "attiny85"],
)
def test_cppcheck_is_content(sources: tuple[str, ...]) -> None:
    run(need("cppcheck"), *CHECKS, *IGNORED, "-I", CORE, *sources)


ON = {  # fuses that are on: their bits are 0; by avrdude's name of the part
    "m328p": {
        "lfuse": "FUSE_CKSEL1",  # SUT 11, CKSEL 1101
        "hfuse": "FUSE_SPIEN & FUSE_EESAVE & FUSE_BOOTSZ1 & FUSE_BOOTSZ0",
        "efuse": "FUSE_BODLEVEL1",  # BODLEVEL 101
    },
    "t85": {
        "lfuse": "FUSE_SUT0 & FUSE_CKSEL3 & FUSE_CKSEL2 & FUSE_CKSEL0",  # SUT 10, CKSEL 0010
        "hfuse": "FUSE_SPIEN & FUSE_EESAVE & FUSE_BODLEVEL1",  # BODLEVEL 101
        "efuse": "0xFF",
    },
}
GCC = {"m328p": "atmega328p", "t85": "attiny85"}


@pytest.mark.parametrize("part", ON)
def test_fuse_bytes_are_those_of_the_fuses_named(part: str, tmp_path: Path) -> None:
    text = (FIRMWARE / "README.md").read_text()
    (line,) = re.findall(rf"avrdude .* -p {part} .*fuse.*", text)
    written = dict(re.findall(r"-U (\wfuse):w:(0x\w\w):m", line))
    assert written.keys() == ON[part].keys()
    header = (FIRMWARE / "node" / f"{GCC[part]}.h").read_text()
    low, high, extended = (written[fuse] for fuse in ("lfuse", "hfuse", "efuse"))
    assert f"(low {low}, high {high}, extended {extended})" in header
    source = tmp_path / "fuses.c"
    source.write_text(
        "#include <avr/io.h>\n"
        + "".join(
            f'_Static_assert((unsigned char)({names}) == {written[fuse]}, "{fuse}");\n'
            for fuse, names in ON[part].items()
        )
    )
    run(need("avr-gcc"), f"-mmcu={GCC[part]}", "-fsyntax-only", source)
