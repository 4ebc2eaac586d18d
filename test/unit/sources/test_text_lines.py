# SPDX-License-Identifier: Apache-2.0

"""text://: what a board prints is read as it is meant, or not at all, and it is told why."""

import math
import random
import time
from itertools import pairwise
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma import Frame, Skin, Status
from tactile_cdma.base.errors import PortError, SpecError
from tactile_cdma.commands.cli import main
from tactile_cdma.sources import TaxelFrame
from tactile_cdma.sources import text as text_module
from tactile_cdma.sources.text import TextLines
from test.support.printing_board import check_of, checked, printing
from test.support.waiting import wait_for

NODES = 4


def lines(query: str = "") -> TextLines:
    """A reader without a port."""
    with mock.patch("tactile_cdma.sources.serial_source.Port"):
        return TextLines(f"text:///dev/null?{query}")


def fed(
    data: bytes, query: str = "", nodes: int | None = NODES, t_host: float = 5.0
) -> list[TaxelFrame]:
    return lines(query).feed(b"rest of a line\n" + data, t_host, nodes)


def values(data: bytes, query: str = "") -> list[list[float]]:
    return [frame.values.tolist() for frame in fed(data, query)]


@pytest.mark.parametrize(
    "line",
    [
        b"1,2,3,1023\n",
        b"1;2;3;1023\r\n",
        b"1\t2\t3\t1023\r",
        b"  1   2 3 1023  \n",
        b"1, 2, 3, 1023,\n",
        b"A0:1,A1:2,A2:3,A3:1023\n",
        b"a=1 b=2 c=3 d=1023\n",
        b"1.00,2.0,3.,1023\n",
        b"+1|2|3|1.023e3\n",
    ],
)
def test_numbers_are_separated_as_boards_do(line: bytes) -> None:
    assert values(line) == [[1, 2, 3, 1023]]


@pytest.mark.parametrize(
    "line",
    [
        b"a,b,c,d\n",
        b"ets Jun  8 2016 00:22:57\n",
        b"1,2,3,4x\n",
        b"1-2-3-4\n",
        b"1,2,3,0x10\n",
        b"1,2,3,4_0\n",
        b"1,2,3,\xff4\n",
        b"1,2,3,inf\n",
    ],
)
def test_what_is_no_line_of_numbers_is_none_and_is_shown(line: bytes) -> None:
    board = lines()
    assert board.feed(b"\n" + line, 0.0, NODES) == []
    assert board.problem and "text comes in place of numbers" in board.problem
    assert board.feed(b"1,2,3,4\n", 0.0, NODES) and board.problem is None


@pytest.mark.parametrize(
    "line, query, said",
    [
        (b"1,2,3\n", "", "lines of 3 numbers come, but nodes is 4"),
        (b"9,1,2,3,4\n", "", "lines of 5 numbers come, but nodes is 4; is one an index, a time"),
        (b"9,1,2,3\n", "before=index", "4 numbers come, but nodes is 4, and 1 columns are none"),
        (b"1,2,3,,4,\n", "after=check", "check of a line is 4, but its numbers have"),
        (b"nan,1,2,3,4\n", "before=index", "beside the taxels has no number"),
        (b"1,2,3,4.5,4\n", "after=check", "not whole"),
    ],
)
def test_a_line_that_does_not_fit_is_none_and_the_reason_is_told(
    line: bytes, query: str, said: str
) -> None:
    board = lines(query)
    nodes = 3 if query == "after=check" and line.startswith(b"1,2,3,,") else NODES
    assert board.feed(b"\n" + line, 0.0, nodes) == []
    assert board.problem is not None and said in board.problem


def test_a_taxel_without_a_number_has_no_reading() -> None:
    assert values(b"1,nan,3,NaN\n")[0] == pytest.approx([1, math.nan, 3, math.nan], nan_ok=True)


def test_columns_beside_the_taxels_are_number_and_time() -> None:
    told = fed(b"7,2500000,3,1,2,3,4,9\n", "before=index,us,skip&after=skip")
    [frame] = told
    assert (frame.number, frame.t_device, frame.values.tolist()) == (7, 2.5, [1, 2, 3, 4])


@pytest.mark.parametrize("unit, per_second", [("us", 10**6), ("ms", 10**3)])
def test_a_time_goes_on_where_its_32_bits_end(unit: str, per_second: int) -> None:
    end = 1 << 32
    ticks = [end - per_second, end - 1, per_second // 2]
    data = b"".join(b"%d,1,2,3,4\n" % tick for tick in ticks)
    times = [frame.t_device for frame in fed(data, f"before={unit}")]
    steps = np.diff(np.array(times, float)) * per_second
    assert steps.round().tolist() == [per_second - 1, per_second // 2 + 1]


def test_a_board_that_was_reset_begins_its_time_anew() -> None:
    data = b"90000000,1,2,3,4\n100,1,2,3,4\n"
    assert [frame.t_device for frame in fed(data, "before=us")] == [90.0, 1e-4]


def test_a_damaged_line_is_a_lost_frame_and_text_is_none() -> None:
    data = b"1,2,3,4\nhello\n1,2,3\n1,2,3,4\n"
    assert [frame.number for frame in fed(data)] == [0, 2]


def test_the_first_piece_of_a_line_is_left_out_though_it_looks_whole() -> None:
    assert lines().feed(b"2,2,3,4\n1,2,3,4\n", 0.0, NODES)[0].values.tolist() == [1, 2, 3, 4]


def test_bytes_without_a_line_are_not_kept_for_ever() -> None:
    board = lines()
    for _ in range(40):
        assert board.feed(b"5" * 4096, 0.0, NODES) == []
        assert len(board._rest) <= text_module.LONGEST_LINE
    assert board.problem and "no line ends" in board.problem
    assert board.feed(b"1,2,3,4\n1,2,3,4\n", 0.0, NODES)[0].values.tolist() == [1, 2, 3, 4]


@given(st.binary(max_size=200), st.lists(st.integers(0, 200), max_size=8))
def test_how_bytes_are_divided_makes_no_difference(noise: bytes, cuts: list[int]) -> None:
    data = b"1,2,3,4\r\n" + noise + b"\n5,6,7,8\r\nreset\r\n9,10,11,12\r\n"
    whole, parts = lines(), lines()
    once = whole.feed(data, 0.0, NODES)
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    pieces = [parts.feed(data[a:b], 0.0, NODES) for a, b in pairwise(edges)]
    split = [frame for piece in pieces for frame in piece]
    assert [f.values.tolist() for f in split] == [f.values.tolist() for f in once]
    assert parts.problem == whole.problem


@pytest.mark.parametrize(
    "query, said",
    [
        ("before=indx", "did you mean 'index"),
        ("before=us,ms", "two columns of time"),
        ("after=check,check", "check twice"),
        ("volts=5&after=check", "leave out volts"),
        ("separator=x", "no option"),
        ("baud=12", "must lie within"),
    ],
)
def test_a_wrong_option_is_refused(query: str, said: str) -> None:
    with pytest.raises(SpecError, match=said):
        lines(query)


def test_the_device_that_is_not_there_is_named() -> None:
    with pytest.raises(PortError, match=r"text:///dev/nowhere.*no such port"):
        Skin("text:///dev/nowhere?baud=9600", nodes=4).open()


# Over a pty, through the whole chain.


def frames_of(skin: Skin, count: int) -> list[Frame]:
    frames: list[Frame] = []
    for frame in skin:
        frames.append(frame)
        if len(frames) == count:
            break
    return frames


def code(frame: int, taxel: int) -> int:
    """What taxel says in a frame: neighbours, and frames, differ."""
    return (frame * 37 + taxel * 101) % 1024


def plain_line(frame: int, nodes: int = NODES) -> bytes:
    return ",".join(str(code(frame, taxel)) for taxel in range(nodes)).encode() + b"\r\n"


@pytest.mark.parametrize(
    "line, query, said",
    [
        (plain_line(0, 5), "", "lines of 5 numbers come, but nodes is 4"),
        (b"1,2,3,3021\n", "", "a code of 3021 comes, beyond 0…1023 of bits 10"),
        (b"1.0,2.0,3.0,4.5\n", "volts=5", "volts of 5 V full scale: set vref_v to that"),
        (b"booting\n", "", "text comes in place of numbers: 'booting'"),
    ],
)
def test_why_a_skin_reads_nothing_is_told(line: bytes, query: str, said: str) -> None:
    with printing(lambda _: line) as device, Skin(f"text://{device}?{query}", nodes=4) as skin:
        wait_for(lambda: skin.problem and "waiting" not in skin.problem)
        assert skin.problem is not None and said in skin.problem


def test_volts_become_the_nearest_codes() -> None:
    with (
        printing(lambda _: b"0.0 1.25 2.5 4.99\n") as device,
        Skin(f"text://{device}?volts=5", nodes=4, vref_v=5.0) as skin,
    ):
        assert skin.read().codes.tolist() == [0, 256, 512, 1022]


def test_a_taxel_that_is_not_read_has_no_certain_value() -> None:
    """Its last value stands, as unheard, and after stale_after_s none: it is never at rest."""

    def line(frame: int) -> bytes:
        return plain_line(frame) if frame < 100 else b"1,2,nan,4\n"

    with printing(line) as device, Skin(f"text://{device}", nodes=4, stale_after_s=0.5) as skin:
        frames = iter(skin)
        doubted = next(frame for frame in frames if not frame.active[2])
        assert doubted.status[2] & Status.UNHEARD == Status.UNHEARD
        assert not (doubted.status[[0, 1, 3]] & Status.LOW_SNR).any()
        stale = next(frame for frame in frames if np.isnan(frame.pressure_pa[2]))
        assert stale.status[2] & Status.STALE and np.isfinite(stale.pressure_pa[[0, 1, 3]]).all()


def test_times_and_numbers_are_those_of_the_board() -> None:
    """Its clock says when, its count what was lost; a reset begins both anew, not the frames'."""
    began_s = time.monotonic()

    def line(made: int) -> bytes:
        if made % 10 == 3:
            return b"torn,1,2\r\n"
        count = made if made < 150 else made - 150
        return checked([count, 1_000_000 + count * 10_000, *(code(made, i) for i in range(NODES))])

    query = "before=index,us&after=check"
    with printing(line) as device, Skin(f"text://{device}?{query}", nodes=NODES) as skin:
        frames = frames_of(skin, 160)
    for before, after in pairwise(frames):
        made = [next(k for k in range(400) if code(k, 0) == f.codes[0]) for f in (before, after)]
        assert after.t_host > before.t_host >= began_s - 1
        if made[0] < 150 <= made[1]:
            assert after.sequence > before.sequence
            assert after.t_device < before.t_device
            continue
        assert after.sequence - before.sequence == made[1] - made[0]
        assert after.t_device - before.t_device == pytest.approx(0.01 * (made[1] - made[0]))


def storm(rng: random.Random, made: int, nodes: int) -> bytes:
    """A line of a board in trouble: whole, torn, changed, doubled, reset or drowned in text."""
    line = checked([made, 5 * made, *(code(made, taxel) for taxel in range(nodes))])
    kind = rng.randrange(10)
    at, size = rng.randrange(len(line)), rng.choice([1, 1, 2, 5, 60, 5000])
    if kind == 0:
        return line[:at] + line[at + size :]  # bytes are lost
    if kind == 1:
        return line[:at]  # reset within a line, the next one follows at once
    if kind == 2:
        return line[:at] + b"ets Jun  8 2016\r\nrst:0x1 (POWERON)\r\n" + line
    if kind == 3:
        changed = bytearray(line)
        for _ in range(rng.randrange(1, 4)):
            changed[rng.randrange(len(line))] = rng.randrange(256)
        return bytes(changed)
    if kind == 4:
        changed = bytearray(line)  # digits only: the line stays one of numbers
        for place in rng.sample([i for i, c in enumerate(line) if chr(c).isdigit()], 2):
            changed[place] = rng.choice(b"0123456789")
        return bytes(changed)
    if kind == 5:
        return line[at:]
    return line


def test_no_value_is_wrong_whatever_comes() -> None:
    """1,024 taxels at 100 Hz, of which half the lines are damaged, over a pty and the chain."""
    nodes, rng = 1024, random.Random(5)
    sent: dict[int, bytes] = {}

    def line(made: int) -> bytes:
        sent[made] = storm(rng, made, nodes)
        return sent[made]

    query = "before=index,skip&after=check"
    with printing(line) as device, Skin(f"text://{device}?{query}", nodes=nodes) as skin:
        frames = frames_of(skin, 250)
    expected = {code(made, 0): made for made in range(900)}
    for frame in frames:
        made = expected[int(frame.codes[0])]
        assert frame.codes.tolist() == [code(made, taxel) for taxel in range(nodes)]
    assert sum(len(line) for line in sent.values()) > 250 * 4 * nodes


def test_lines_torn_at_numbers_have_no_wrong_value_without_a_check() -> None:
    rng = random.Random(7)

    def line(made: int) -> bytes:
        whole = plain_line(made, 16)
        commas = [i for i, c in enumerate(whole) if c == ord(",")]
        kind, at = rng.randrange(4), rng.choice(commas)
        return {0: whole[:at], 1: whole[at + 1 :], 2: b"brownout\r\n" + whole}.get(kind, whole)

    with printing(line) as device, Skin(f"text://{device}", nodes=16) as skin:
        frames = frames_of(skin, 100)
    rows = {tuple(code(made, taxel) for taxel in range(16)) for made in range(1024)}
    assert all(tuple(frame.codes.tolist()) in rows for frame in frames)


def test_recordings_checks_and_exports_are_as_of_any_skin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def line(made: int) -> bytes:
        # Pressed from the third second on: the default curve falls with pressure.
        codes = [1022] * 16 if made < 200 else range(700, 716)
        return checked([made, made * 10_000, *codes])

    path, query = tmp_path / "touch.skin", "before=index,us&after=check"
    with printing(line) as device:
        url = f"text://{device}?{query}"
        assert main(["record", url, str(path), "--seconds", "4", "--nodes", "16"]) == 0
    with printing(line) as device:
        assert main(["doctor", f"text://{device}?{query}"]) == 0
        said = capsys.readouterr().out
        assert "16 of 16 spoke" in said and "a source without chips" in said
        assert "100.0 of 100.0 per s, 0 lost" in said
    assert main(["info", str(path)]) == 0
    assert main(["export", str(path), "-o", str(tmp_path / "touch.npz")]) == 0
    table = np.load(tmp_path / "touch.npz")
    with Skin(f"replay://{path}?speed=0", nodes=16, contacts=True) as skin:
        replayed = list(skin)
    assert len(replayed) == len(table["pressure_pa"]) > 200
    assert replayed[-1].touched and not replayed[0].touched
    assert np.array_equal(replayed[-1].codes, 700 + np.arange(16))
    assert {int(step) for step in np.diff([frame.sequence for frame in replayed])} == {1}


def test_a_check_is_that_of_the_sketch() -> None:
    numbers = [1, 2, 3, 1023]
    assert check_of(numbers) == ((1 * 31 + 2) * 31 + 3) * 31 + 1023
    assert fed(checked(numbers), "after=check")
    sketch = Path(__file__).parents[3] / "examples/arduino_text/arduino_text.ino"
    assert "check = check * 31 + number;" in sketch.read_text(encoding="utf-8")
