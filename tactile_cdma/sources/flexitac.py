# SPDX-License-Identifier: Apache-2.0

"""flexitac://: the stream of FlexiTac's boards, two bytes 0xAA 0x55 and a byte for each taxel.

As its public programs write and read it: rows one by one, 8 bits of the converter's 10, 2 MBd,
neither length nor check. So a frame counts where a mark stands before and after it, and a place
that only looks like one, in the pressures, is told from it by the frames before.
"""

import numpy as np

from .serial_source import SerialSource
from .taxel_source import TaxelFrame

MARK = b"\xaa\x55"
AGREEING = 3
"""Frames in a row whose marks have to agree before the first one counts. Chosen: two taxels that
change may look like a mark twice."""


class FlexiTac(SerialSource):
    """Finds frames by their marks; see SerialSource."""

    BAUD = 2_000_000
    bits: int | None = 8

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self._bytes = bytearray()
        self._is_found = False  # the bytes begin with a frame's mark

    def feed(self, data: bytes, t_host: float, nodes: int | None) -> list[TaxelFrame]:
        if nodes is None:
            self.problem = "how many taxels a frame has is not known: set nodes"
            return []
        kept, size, frames = self._bytes, len(MARK) + nodes, list[TaxelFrame]()
        kept += data
        while True:
            if not self._is_found and not self._find(size):
                return frames
            if len(kept) < size + len(MARK):
                return frames
            if kept[size : size + len(MARK)] == MARK:
                values = np.frombuffer(bytes(kept[len(MARK) : size]), np.uint8)
                frames.append(TaxelFrame(values, t_host))
                self.problem = None
                del kept[:size]
            else:  # bytes are missing, or too many
                self._is_found = False
                del kept[:1]

    def _find(self, size: int) -> bool:
        """Drop bytes up to the one place where marks agree; returns whether there is one."""
        kept = self._bytes
        needed = AGREEING * size + len(MARK)
        while len(kept) >= needed + size:
            places = [
                place
                for place in range(size)
                if all(
                    kept[place + i * size : place + i * size + len(MARK)] == MARK
                    for i in range(AGREEING + 1)
                )
            ]
            if len(places) == 1:
                del kept[: places[0] + AGREEING * size]  # when those came is not known any more
                self._is_found = True
                return True
            what = "no marks" if not places else f"marks at {len(places)} places"
            self.problem = f"{what} {size - len(MARK)} taxels apart: are nodes and baud right?"
            del kept[:size]
        return False
