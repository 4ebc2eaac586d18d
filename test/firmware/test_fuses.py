# SPDX-License-Identifier: Apache-2.0

"""The fuse bytes in firmware/README.md match the fuses named there."""

import re
from pathlib import Path

import pytest

from test.support.firmware import FIRMWARE, need, run

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
