# SPDX-License-Identifier: Apache-2.0

"""The RP2040's image as the boot ROM and a bootloader read it."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from test.support.firmware import FIRMWARE, need, run
from test.support.programs import run_program

FLASH, RAM, RAM_SIZE = 0x10000000, 0x20000000, 0x42000
BOOT_SIZE = 256


@pytest.fixture(scope="module")
def built_rp2040(built: Callable[[str], Path]) -> Path:
    need("arm-none-eabi-gcc")
    return built("rp2040") / "rp2040"


def mpeg_crc(data: bytes) -> int:
    """CRC-32/MPEG-2 by the definition, bit by bit; its check value is 0x0376E6E7."""
    register = 0xFFFFFFFF
    for byte in data:
        for bit in range(7, -1, -1):
            top = register >> 31 ^ byte >> bit & 1
            register = register << 1 & 0xFFFFFFFF ^ 0x04C11DB7 * top
    return register


def test_the_boot_rom_accepts_the_second_stage(built_rp2040: Path) -> None:
    assert mpeg_crc(b"123456789") == 0x0376E6E7
    image = (built_rp2040 / "digitizer.bin").read_bytes()
    assert mpeg_crc(image[: BOOT_SIZE - 4]) == struct.unpack_from("<I", image, BOOT_SIZE - 4)[0]
    stack, reset = struct.unpack_from("<2I", image, BOOT_SIZE)
    assert stack == RAM + RAM_SIZE
    assert reset & 1 and FLASH < reset < FLASH + len(image), "starts in flash, in Thumb state"


def test_a_second_stage_that_is_too_long_is_refused(tmp_path: Path) -> None:
    (tmp_path / "linked.bin").write_bytes(b"\1" * 300)
    command = ("python3", FIRMWARE / "digitizer/rp2040/image.py", "linked.bin", "a.bin", "a.uf2")
    done = run_program(*command, cwd=tmp_path)
    assert done.returncode and "boot stage is longer than 252 bytes" in done.stderr
    assert not (tmp_path / "a.uf2").exists()


def test_uf2_holds_the_image(built_rp2040: Path) -> None:
    image = (built_rp2040 / "digitizer.bin").read_bytes()
    packed = (built_rp2040 / "digitizer.uf2").read_bytes()
    assert len(packed) % 512 == 0
    blocks = [packed[i : i + 512] for i in range(0, len(packed), 512)]
    content = b""
    for number, block in enumerate(blocks):
        first, second, flags, address, size, place, count, family = struct.unpack_from("<8I", block)
        assert (first, second) == (0x0A324655, 0x9E5D5157)
        assert block[-4:] == struct.pack("<I", 0x0AB16F30)
        assert (flags, family) == (0x2000, 0xE48BFF56), "for an RP2040, and to its flash"
        assert (place, count, size) == (number, len(blocks), 256)
        assert address == FLASH + number * 256
        content += block[32 : 32 + size]
    assert content.rstrip(b"\0") == image.rstrip(b"\0")
    assert len(content) - len(image) < 256


def test_all_code_but_the_start_runs_from_ram(built_rp2040: Path) -> None:
    """Waits for flash would make times depend on its cache."""
    listing = run(need("arm-none-eabi-nm"), "-S", built_rp2040 / "digitizer.elf")
    rows = [line.split() for line in listing.splitlines()]
    functions = {row[3]: int(row[0], 16) for row in rows if len(row) == 4 and row[2] in "tT"}
    in_flash = {name for name, address in functions.items() if address < RAM}
    assert in_flash <= {"flash_vectors", "reset", "__main_veneer"}
    assert {"main", "sync_interrupt", "stream_samples"} <= functions.keys() - in_flash
