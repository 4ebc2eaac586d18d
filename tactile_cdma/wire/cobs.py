# SPDX-License-Identifier: Apache-2.0

"""Consistent Overhead Byte Stuffing (Cheshire and Baker 1999): bytes without any zero byte."""

from __future__ import annotations


def cobs_encode(data: bytes) -> bytes:
    """Data without any zero byte.

    A zero is imagined after the data; then each run of non-zero bytes, with the zero that ends it,
    becomes a block: its length, counting the zero, and the run. A block of 255 is 254 bytes
    without a zero.
    """
    out: list[bytes] = []
    for run in data.split(b"\0"):
        full = len(run) // 254 * 254
        for start in range(0, full, 254):
            out += (b"\xff", run[start : start + 254])
        out += (_LENGTHS[len(run) - full], run[full:])
    if run and len(run) == full:  # a full block may end the data without the imagined zero
        del out[-2:]
    return b"".join(out)


def cobs_decode(data: bytes) -> bytes:
    """The inverse of cobs_encode. Raises ValueError for what is no COBS."""
    if 0 in data:
        raise ValueError(f"no COBS: a zero at byte {data.index(0)} of {len(data)}")
    decoded, unended = bytearray(data), []
    start, size = 0, len(data)
    while start < size:
        length = data[start]
        decoded[start] = 0  # a block's first byte lies where the zero of the block before it was
        start += length
        if length == 255:
            unended.append(start)  # where no zero was
    if start != size:
        raise ValueError(f"no COBS: the last block ends at byte {start} of {size}")
    parts, begin = [], 1
    for end in unended:
        parts.append(decoded[begin:end])
        begin = end + 1
    parts.append(decoded[begin:])
    return b"".join(parts)


_LENGTHS = [bytes([size + 1]) for size in range(254)]
"""A block's first byte for every number of bytes that follow."""
