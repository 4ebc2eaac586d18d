"""Consistent Overhead Byte Stuffing (Cheshire and Baker 1999): bytes without any zero byte."""

from __future__ import annotations


def cobs_encode(data: bytes) -> bytes:
    """Data without any zero byte.

    A zero is imagined after the data; then each run of non-zero bytes, with the zero that ends it,
    becomes a block: its length, counting the zero, and the run. A block of 255 is 254 bytes
    without a zero.
    """
    out = bytearray()
    for run in data.split(b"\0"):
        full = len(run) // 254 * 254
        for start in range(0, full, 254):
            out.append(255)
            out += run[start : start + 254]
        out.append(len(run) - full + 1)
        out += run[full:]
    if run and len(run) == full:  # a full block may end the data without the imagined zero
        del out[-1]
    return bytes(out)


def cobs_decode(data: bytes) -> bytes:
    """The inverse of cobs_encode. Raises ValueError for what is no COBS."""
    decoded, unended = bytearray(data), []
    start, size = 0, len(data)
    while start < size:
        length = data[start]
        decoded[start] = 0  # a block's first byte lies where the zero of the block before it was
        if length == 255:
            unended.append(start + 255)  # where no zero was
        elif not length:
            raise ValueError(f"no COBS: a zero at byte {start} of {size}")
        start += length
    if start != size:
        raise ValueError(f"no COBS: the last block ends at byte {start} of {size}")
    for position in reversed(unended):
        del decoded[position : position + 1]
    return bytes(decoded[1:])
