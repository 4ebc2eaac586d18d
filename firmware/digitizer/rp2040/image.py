# SPDX-License-Identifier: Apache-2.0

"""Make an RP2040's flash image from the linker's output: add the boot stage's CRC, pack it as UF2.

python image.py linked.bin digitizer.bin digitizer.uf2
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path

FLASH = 0x10000000
BOOT2_SIZE = 256
"""Bytes that the boot ROM loads and checks; the last four are the CRC of the rest."""
UF2_PAYLOAD = 256
UF2_MAGIC = (0x0A324655, 0x9E5D5157, 0x0AB16F30)
UF2_HAS_FAMILY = 0x2000
RP2040_FAMILY = 0xE48BFF56


def boot_crc(data: bytes) -> int:
    """Compute the boot ROM's CRC-32: that of IEEE 802.3, but neither reflected nor inverted."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ (0x04C11DB7 if crc >> 31 else 0)) & 0xFFFFFFFF
    return crc


def with_boot_crc(image: bytes) -> bytes:
    """Give the image its boot stage's CRC. ValueError if the boot stage leaves no room."""
    body = image[: BOOT2_SIZE - 4]
    if any(image[BOOT2_SIZE - 4 : BOOT2_SIZE]):
        raise ValueError(f"the boot stage is longer than {BOOT2_SIZE - 4} bytes")
    return body + struct.pack("<I", boot_crc(body)) + image[BOOT2_SIZE:]


def uf2(image: bytes, address: int = FLASH) -> bytes:
    """Make a UF2 file of the image, which can be copied to the board's USB drive."""
    pieces = [image[i : i + UF2_PAYLOAD] for i in range(0, len(image), UF2_PAYLOAD)]
    first, second, last = UF2_MAGIC
    return b"".join(
        struct.pack(
            "<8I476sI",
            first,
            second,
            UF2_HAS_FAMILY,
            address + number * UF2_PAYLOAD,
            UF2_PAYLOAD,
            number,
            len(pieces),
            RP2040_FAMILY,
            piece,
            last,
        )
        for number, piece in enumerate(pieces)
    )


if __name__ == "__main__":
    linked, binary, packed = map(Path, sys.argv[1:])
    whole = with_boot_crc(linked.read_bytes())
    binary.write_bytes(whole)
    packed.write_bytes(uf2(whole))
