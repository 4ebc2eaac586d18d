# SPDX-License-Identifier: Apache-2.0

"""Consistent Overhead Byte Stuffing (Cheshire and Baker 1999): encodes bytes without zeros."""


def cobs_encode(data: bytes) -> bytes:
    """Return the data encoded without zeros.

    With a zero appended, the data is a sequence of runs of non-zero bytes, each ended by a zero.
    A run becomes a block: the run's length with its zero, then the run. Runs of more than 254
    bytes are cut: length 255 stands for 254 bytes and no zero.
    """
    out: list[bytes] = []
    for run in data.split(b"\0"):
        full = len(run) // 254 * 254
        for start in range(0, full, 254):
            out += (b"\xff", run[start : start + 254])
        out += (_LENGTHS[len(run) - full], run[full:])
    if run and len(run) == full:  # a full block at the end needs no block for the appended zero
        del out[-2:]
    return b"".join(out)


def cobs_decode(data: bytes) -> bytes:
    """Undo cobs_encode. Raises ValueError for anything that is not COBS."""
    if 0 in data:
        raise ValueError(f"no COBS: a zero at byte {data.index(0)} of {len(data)}")
    decoded, unended = bytearray(data), []
    start, size = 0, len(data)
    while start < size:
        length = data[start]
        decoded[start] = 0  # a length stands where the zero of the block before it was
        start += length
        if length == 255:
            unended.append(start)  # its length stands where no zero was
    if start != size:
        raise ValueError(f"no COBS: the last block ends at byte {start} of {size}")
    parts, begin = [], 1
    for end in unended:
        parts.append(decoded[begin:end])
        begin = end + 1
    parts.append(decoded[begin:])
    return b"".join(parts)


_LENGTHS = [bytes([size + 1]) for size in range(254)]
"""The length byte of a block, by the number of bytes in its run."""
