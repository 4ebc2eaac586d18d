# SPDX-License-Identifier: Apache-2.0

"""Checks around the firmware: no board in core/, cppcheck, fuses, sanitizers, missing tools."""

import os
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from tactile_cdma.hardware.flashing import BOARDS
from test.support.firmware import CORE, FIRMWARE, SANITIZED, STRICT, need, run
from test.support.programs import run_python

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
OF_ONE = ("-i", NODE / "chips_four.c")
OF_FOUR = ("-i", NODE / "chips_match.c", "-i", NODE / "chips_usart.c")
"""What nodes of one sensor, and of four, do without."""
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
        ("-D__AVR_ATmega328P__", "-i", NODE / "attiny85.c", *OF_ONE, *AVR),
        ("-D__AVR_ATmega328P__", "-DNODE_FOUR", "-i", NODE / "attiny85.c", *OF_FOUR, *AVR),
        ("-D__AVR_ATtiny85__", "-i", NODE / "atmega328p.c", *OF_ONE, *AVR),
    ],
    ids=["digitizer", "atmega328p", "four", "attiny85"],
)
def test_cppcheck_is_content(sources: tuple[str, ...]) -> None:
    run(need("cppcheck"), *CHECKS, *IGNORED, "-I", CORE, *sources)


OWN_OSCILLATOR = "FUSE_SUT0 & FUSE_CKSEL3 & FUSE_CKSEL2 & FUSE_CKSEL0"
"""SUT 10, CKSEL 0010; of an ATtiny85 and of an ATmega328P."""
MEGA = ("FUSE_SPIEN & FUSE_EESAVE & FUSE_BOOTSZ1 & FUSE_BOOTSZ0", "FUSE_BODLEVEL1")
"""No boot loader; BODLEVEL 101."""
ON = {  # fuses that are on: their bits are 0
    "strip": (OWN_OSCILLATOR, *MEGA),
    "fast": ("FUSE_CKSEL1", *MEGA),  # SUT 11, CKSEL 1101
    "attiny85": (OWN_OSCILLATOR, "FUSE_SPIEN & FUSE_EESAVE & FUSE_BODLEVEL1", "0xFF"),
}


@pytest.mark.parametrize("name", ON)
def test_fuse_bytes_are_those_of_the_fuses_named(name: str, tmp_path: Path) -> None:
    board = BOARDS[name]
    part = board.mcu.split("-")[0]
    text = (FIRMWARE / "README.md").read_text()
    assert all(f"0x{byte:02X}" in text for byte in board.fuses)
    if name != "strip":
        low, high, extended = (f"0x{byte:02X}" for byte in board.fuses)
        header = (FIRMWARE / "node" / f"{part}.h").read_text()
        assert f"(low {low}, high {high}, extended {extended})" in header
    source = tmp_path / "fuses.c"
    source.write_text(
        "#include <avr/io.h>\n"
        + "".join(
            f'_Static_assert((unsigned char)({names}) == {byte}, "{names}");\n'
            for byte, names in zip(board.fuses, ON[name], strict=True)
        )
    )
    run(need("avr-gcc"), f"-mmcu={part}", "-fsyntax-only", source)


HERE = Path(__file__).parent
TESTS = [*HERE.glob("test_core_[!r]*.py"), HERE / "test_node_core.py"]
"""Those that call the core as a library: all but the replay."""


@pytest.mark.slow
def test_the_core_stays_within_its_memory_and_its_numbers() -> None:
    library = run(need("cc"), "-print-file-name=libasan.so").strip()
    if not Path(library).is_absolute():
        pytest.skip("this compiler has no libasan.so: the core is not tested with sanitizers")
    # Python itself leaks, and its allocator is none of ours.
    watched = {"LD_PRELOAD": library, "ASAN_OPTIONS": "detect_leaks=0", SANITIZED: "1"}
    # Not captured: what a sanitizer says would be lost with the process that it ends.
    quietly = ("-q", "-x", "-s", "-p", "no:cacheprovider", "--hypothesis-profile", "quick")
    command = ("-m", "pytest", *quietly, *TESTS)
    result = run_python(*command, env={**os.environ, **watched}, timeout=600)
    assert result.returncode == 0, result.stdout[-5000:] + result.stderr[-5000:]


@pytest.mark.parametrize(
    ("target", "missing"),
    [
        ("node", "avr-gcc"),
        ("rp2040", "arm-none-eabi-gcc"),
        ("replay-arm", "arm-none-eabi-gcc"),
        ("replay-native", "cc"),
        ("sim", "cc"),
        ("sim", "libsimavr-dev"),
    ],
)
def test_target_without_its_tools_skips(
    built: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    target: str,
    missing: str,
) -> None:
    if missing == "libsimavr-dev":
        monkeypatch.setattr("test.support.firmware.SIMAVR", tmp_path / "sim_avr.h")
    else:
        monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(pytest.skip.Exception, match=f"no {missing} on this machine"):
        built(target)


def test_mistakes_to_plant_fit_the_sources() -> None:
    """Each stands once in its file, and its tests are there (`make firmware-mutants` runs them)."""
    mutants = tomllib.loads((FIRMWARE / "mutants.toml").read_text())["mutant"]
    assert len(mutants) >= 60
    for mutant in mutants:
        text = (FIRMWARE / mutant["file"]).read_text()
        assert text.count(mutant["old"]) == 1, mutant["name"]
        for test in mutant["tests"]:
            name, *functions = test.split("::")
            tests = Path(__file__).with_name(name).read_text()
            assert all(f"def {function}(" in tests for function in functions), test
