# SPDX-License-Identifier: Apache-2.0

"""flexitac://: frames as FlexiTac's boards send them; no piece of one is taken for a frame."""

import random
from itertools import count
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma import Skin
from tactile_cdma.sources.flexitac import AGREEING, MARK, FlexiTac
from test.support.printing_board import printing
from test.support.waiting import wait_for

ROWS, COLUMNS = 12, 32  # of the board that its firmware is made for
NODES = ROWS * COLUMNS


def taxels(made: int) -> bytes:
    return bytes((made * 3 + taxel * 7) % 256 for taxel in range(NODES))


def sent(made: int) -> bytes:
    """A frame, written as the firmware does: mark, then row by row a byte of each column."""
    content = taxels(made)
    data = bytearray((0xAA, 0x55))
    for row in range(ROWS):
        for column in range(COLUMNS):
            data.append(content[row * COLUMNS + column])
    return bytes(data)


def board() -> FlexiTac:
    with mock.patch("tactile_cdma.sources.serial_source.Port"):
        return FlexiTac("flexitac:///dev/null")


def told(data: bytes, pieces: int = 4096) -> list[bytes]:
    source = board()
    parts = (data[at : at + pieces] for at in range(0, len(data), pieces))
    return [frame.values.tobytes() for part in parts for frame in source.feed(part, 0.0, NODES)]


def test_frames_are_found_from_anywhere_in_the_stream() -> None:
    data = b"".join(map(sent, range(20)))
    expected = [taxels(made) for made in range(20)]
    for begin in (0, 1, 100, NODES, NODES + 1):
        found = told(data[begin:])
        assert found == expected[-1 - len(found) : -1]
        assert len(found) >= 20 - AGREEING - 3


@given(st.integers(1, 900))
def test_how_bytes_are_divided_makes_no_difference(pieces: int) -> None:
    data = b"\x55\xaa" + b"".join(map(sent, range(9)))
    assert told(data, pieces) == told(data)


def test_no_frame_that_lost_or_gained_bytes_is_one() -> None:
    rng, data, made = random.Random(3), bytearray(), count()
    frames = set()
    for _ in range(400):
        number = next(made)
        frames.add(taxels(number))
        frame = bytearray(sent(number))
        if rng.random() < 0.1:
            at = rng.randrange(len(frame))
            if rng.random() < 0.5:
                del frame[at : at + rng.randrange(1, 200)]
            else:
                frame[at:at] = rng.randbytes(rng.randrange(1, 200))
        data += frame
    found = told(bytes(data))
    assert set(found) <= frames and len(found) > 100


def test_taxels_that_look_like_a_mark_for_ever_are_no_mark() -> None:
    """Which of two places is the mark cannot be told: so nothing is claimed, until it can be."""
    pressed = bytearray(taxels(0))
    pressed[40:42] = MARK
    source = board()
    assert source.feed((MARK + bytes(pressed)) * 20, 0.0, NODES) == []
    assert source.problem is not None and "marks at 2 places" in source.problem
    found = source.feed(b"".join(map(sent, range(20))), 0.0, NODES)
    values = [frame.values.tobytes() for frame in found]
    assert values and set(values) <= {taxels(made) for made in range(20)}
    again = source.feed((MARK + bytes(pressed)) * 5, 0.0, NODES)
    assert [frame.values.tobytes() for frame in again][-1] == bytes(pressed)


@pytest.mark.parametrize("nodes", [NODES - 1, NODES + 1, 512])
def test_another_number_of_taxels_is_told(nodes: int) -> None:
    source = board()
    assert source.feed(b"".join(map(sent, range(30))), 0.0, nodes) == []
    assert source.problem is not None and f"no marks {nodes} taxels apart" in source.problem


def test_a_skin_reads_it_with_eight_bits_and_no_others() -> None:
    with printing(sent, 40.0) as device:
        with Skin(f"flexitac://{device}", nodes=NODES, rows=ROWS, bits=8) as skin:
            frames = [skin.read() for _ in range(20)]
        with Skin(f"flexitac://{device}", nodes=NODES, rows=ROWS) as skin:
            wait_for(lambda: skin.problem and "the source has bits 8" in skin.problem)
    rows = {taxels(made) for made in range(256)}
    assert all(frame.codes.astype(np.uint8).tobytes() in rows for frame in frames)
    assert frames[0].shape == (ROWS, COLUMNS)
