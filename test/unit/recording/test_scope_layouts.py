# SPDX-License-Identifier: Apache-2.0

"""Oscilloscope captures, as each maker writes them: decoded to the words that were sent."""

import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.base.text import lines_of
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.recording import scope_csv
from tactile_cdma.recording.recording_file import is_text
from tactile_cdma.recording.scope_csv import read_scope_csv
from tactile_cdma.sim.channel import Channel
from test.support.command_line import Printed, Refused
from test.support.simulated import scope_capture

TIME_S = -1e-3 + np.arange(400) * 5e-6
VOLTS = np.sin(np.arange(400) / 7)


def write(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def rows(time_s: np.ndarray = TIME_S, volts: np.ndarray = VOLTS, sep: str = ",") -> list[str]:
    return [f"{t:.5E}{sep}{v:+.4E}" for t, v in zip(time_s, volts, strict=True)]


@pytest.mark.parametrize(
    "header",
    [
        [],
        ["x-axis,1", "second,Volt"],
        ["Model,MSOX2024A", "", "Time (s),Channel 1 (V)"],
        ["\ufeffTime,Voltage"],
    ],
)
@pytest.mark.parametrize("sep", [",", ";", "\t", "  "])
def test_header_lines_and_delimiters_do_not_matter(
    tmp_path: Path, header: list[str], sep: str
) -> None:
    capture = read_scope_csv(write(tmp_path / "scope.csv", header + rows(sep=sep)))
    [(start_s, volts)] = capture.pieces
    assert start_s == pytest.approx(-1e-3)
    assert capture.rate_hz == pytest.approx(200e3, rel=1e-3)
    assert np.allclose(volts, VOLTS, atol=1e-3)
    assert capture.notes == ()


@pytest.mark.parametrize(
    ("count", "begin_s", "form", "within"),
    [(20_000, 0.0, "{:.6f}", 1e-4), (400, 0.1, "{:.3e}", 0.06)],
)
def test_times_of_few_digits_are_taken_as_evenly_spaced(
    tmp_path: Path, count: int, begin_s: float, form: str, within: float
) -> None:
    """Whole µs, at 5 µs a sample, give the exact mean rate; 20 times of 400 samples nearly so."""
    lines = [f"{form.format(t)},0.1" for t in begin_s + np.arange(count) * 5e-6]
    capture = read_scope_csv(write(tmp_path / "scope.csv", lines))
    assert len(capture.pieces) == 1
    assert capture.rate_hz == pytest.approx(200e3, rel=within)


@pytest.mark.parametrize("bad", ["nan", "inf", "9.9E+37"])
def test_non_numbers_split_the_recording_and_are_noted(tmp_path: Path, bad: str) -> None:
    lines = rows()
    lines[100] = f"{TIME_S[100]:.5E},{bad}"
    capture = read_scope_csv(write(tmp_path / "scope.csv", ["time,volt", *lines]))
    assert [len(volts) for _, volts in capture.pieces] == [100, 299]
    assert capture.notes == (
        "1 of 400 samples are no numbers (first in line 102); decoding what lies between them",
    )
    assert all(np.isfinite(volts).all() for _, volts in capture.pieces)


def test_missing_samples_split_the_recording_and_are_noted(tmp_path: Path) -> None:
    keep = np.r_[0:150, 180:400]
    capture = read_scope_csv(write(tmp_path / "scope.csv", rows(TIME_S[keep], VOLTS[keep])))
    assert [len(volts) for _, volts in capture.pieces] == [150, 220]
    assert capture.pieces[1][0] == pytest.approx(TIME_S[180])
    assert "first before line 151" in capture.notes[0]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["some", "text"], "no lines of numbers"),
        (["1_0,1_0"] * 20, "no lines of numbers"),
        ([*rows()[:50], "0.1,1_0", *rows()[50:]], "line 51 has no numbers.* 1, 2: '0.1,1_0'"),
        (rows()[:8], "only 8 samples"),
        ([*rows()[:50], "oops,0.1", *rows()[50:]], "line 51 has no numbers.*'oops,0.1'"),
        ([*rows()[:50], "0.1", *rows()[50:]], "line 51 has no numbers.*'0.1'"),
        (rows(TIME_S[::-1]), "no column of rising times"),
        (rows(np.zeros(400)), "no column of rising times"),
        (["time,volt", *rows(TIME_S[::-1])], "times do not rise"),
        (rows(np.r_[TIME_S[:300], TIME_S[:100]]), "time runs backwards in line 301"),
    ],
)
def test_broken_files_name_the_place(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(CaptureError, match=message):
        read_scope_csv(write(tmp_path / "scope.csv", lines))


def test_empty_and_missing_files_are_named(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.touch()
    with pytest.raises(CaptureError, match="empty: the file is empty"):
        is_text(empty)
    with pytest.raises(CaptureError, match="nowhere: No such file"):
        is_text(tmp_path / "nowhere")


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(min_size=1, max_size=400))
def test_any_bytes_are_a_capture_or_one_clear_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "any"
    path.write_bytes(content)
    try:
        capture = read_scope_csv(path) if is_text(path) else None
    except CaptureError as error:
        assert str(path) in str(error)
    else:
        assert capture is None or capture.rate_hz > 0


RATE_HZ = 160e3
START_S = -2e-3
CODES = (np.arange(16) * 61 + 17) % 1024
FRAMES = 3


@dataclass(frozen=True)
class Line:
    """What a scope sees: t (m,) s, v (m,) V on the line, w (m,) V on another channel."""

    t: NDArray[np.float64]
    v: NDArray[np.float32]
    w: NDArray[np.float64]

    def rows(self, form: str) -> list[str]:
        """One text per sample; form: of i, t, v, w."""
        columns = (range(len(self.t)), self.t, self.v, self.w)
        return [form.format(i=i, t=t, v=v, w=w) for i, t, v, w in zip(*columns, strict=True)]


@pytest.fixture(scope="module")
def line() -> Line:
    frames = [(CODES, np.ones(16, bool))] * FRAMES
    t, v = scope_capture(FrameSpec(), frames, RATE_HZ, Channel(noise_rms_v=0.005, offset_v=0.02))
    return Line(t + START_S, v, 0.5 * np.sign(np.sin(t * 5e3)))


Writer = Callable[[Line], str]
LAYOUTS: dict[str, tuple[Writer, str]] = {}
"""Per scope: what it writes, and what is said of it."""
WITHOUT_START = ("LeCroy WaveJet", "OWON", "sigrok")
"""Their times begin at the first sample."""


def layout(name: str, taken: str) -> Callable[[Writer], Writer]:
    def add(writer: Writer) -> Writer:
        LAYOUTS[name] = writer, taken
        return writer

    return add


def text(*header: str, rows: list[str], end: str = "\n") -> str:
    return end.join([*header, *rows]) + end


@layout("Keysight InfiniiVision", "channel 1 of 2 (1 Volt), 160 kS/s, V")
def keysight(line: Line) -> str:
    rows = line.rows("{t:+.6E},{v:+.5E},{w:+.5E}")
    return text("x-axis,1,2", "second,Volt,Volt", rows=rows)


@layout("Keysight, segments", "channel 1 of 1 (1 Volt), 160 kS/s, V")
def keysight_segments(line: Line) -> str:
    rows = line.rows("{t:+.6E},{v:+.5E}")
    rows[7] = rows[7].split(",")[0] + ",9.9E+37"
    return text("points/segment = 1000", "x-axis,1", "second,Volt", rows=rows)


@layout("Keysight Infiniium", "channel 1 of 1, 160 kS/s, V, as no unit is named")
def infiniium(line: Line) -> str:
    header = ("Revision:,0", "Type:,raw", "Start:,0", f"Points:,{len(line.t)}", "Count:,1")
    units = (f"XInc:,{1 / RATE_HZ:.8E}", f"XOrg:,{START_S:.6E}", "YUnits:,Volt", "XUnits:,Second")
    return text(*header, *units, "Data:", rows=line.rows("{v:.5E}"))


@layout("Rigol DS1000E", "channel 1 of 2 (CH1 Volt), 160 kS/s, V")
def rigol_old(line: Line) -> str:
    rows = line.rows("{t:.6e},{v:.2e},{w:.2e},")
    return text("X,CH1,CH2,", "Second,Volt,Volt,", rows=rows, end="\r\n")


@layout("Rigol DS1000Z, DS2000, DS4000", "channel 1 of 2 (CH1 Volt), 160 kS/s, V")
def rigol_counts(line: Line) -> str:
    told = f"Sequence,Volt,Volt,,{START_S:.6e},{1 / RATE_HZ:.6e}"
    rows = line.rows("{i},{v:.2e},{w:.2e},0x00,")
    return text("X,CH1,CH2,D7-D0,Start,Increment,", told, rows=rows)


@layout("Rigol MSO5000, DHO", "channel 1 of 2 (CH1V), 160 kS/s, V")
def rigol_new(line: Line) -> str:
    heading = f"CH1V,CH2V,t0 ={START_S:.6e}s, tInc = {1 / RATE_HZ:.6e},"
    return text(heading, rows=line.rows("{v:.5f},{w:.5f},,"))


@layout("Rigol DHO, times", "channel 1 of 4 (CH1(V)), 160 kS/s, V")
def rigol_times(line: Line) -> str:
    rows = line.rows("{t:.8f},{v:.4f},{w:.4f},{w:.4f},{w:.4f}")
    return text("Time(s),CH1(V),CH2(V),CH3(V),CH4(V)", rows=rows)


@layout("Tektronix TDS", "channel 1 of 1, 160 kS/s, V, as no unit is named")
def tektronix_tds(line: Line) -> str:
    told = [f"Record Length,{len(line.t):e}", f"Sample Interval,{1 / RATE_HZ:e}"]
    told += ["Trigger Point,1.25e+03", ",", ",", ",", "Source,CH1", "Vertical Units,V"]
    told += ["Vertical Scale,2.0e-01", "Vertical Offset,0.0e+00", "Horizontal Units,s"]
    told += ["Horizontal Scale,2.5e-04", "Pt Fmt,Y", "Yzero,0.0e+00", "Probe Atten,1.0e+00"]
    told += ["Model Number,TDS2024", "Serial Number,", "Firmware Version,FV:v10.16"]
    told += [","] * (len(line.t) - len(told))
    rows = line.rows("{t:018.12f}, {v:8.5f},")
    return text(rows=[f"{a},,{b}" for a, b in zip(told, rows, strict=True)], end="\r\n")


@layout("Tektronix MSO, DPO", "channel 1 of 2 (CH1), 160 kS/s, V, as no unit is named")
def tektronix_mso(line: Line) -> str:
    told = ("Model,MSO3014", "Firmware Version,2.24", "", "Point Format,Y,", "Horizontal Units,S,")
    more = (f"Sample Interval,{1 / RATE_HZ:.3e},", "Vertical Units,V,V", "Label,,")
    return text(*told, *more, "TIME,CH1,CH2", rows=line.rows("{t:.6e},{v:.5f},{w:.5f}"))


@layout("R&S RTB, RTM", "channel 1 of 2 (C1 in V), 160 kS/s, V")
def rohde_schwarz(line: Line) -> str:
    return text("in s,C1 in V,C2 in V", rows=line.rows("{t:.6E},{v:.5E},{w:.5E}"))


@layout("Siglent, old", "channel 1 of 1 (Value), 160 kS/s, V, as no unit is named")
def siglent_old(line: Line) -> str:
    told = ("Record Length,Analog:8000,", f"Sample Interval,Analog:{1 / RATE_HZ:.6E},")
    more = ("Vertical Units,CH1:V,,", "Horizontal Units,s", "Model Number,SDS1104X-E", "Source,CH1")
    return text(*told, *more, "Second,Value", rows=line.rows("{t:+.6E},{v:+.6E}"))


@layout("Siglent, bin2csv", "channel 1 of 2 (Volt), 160 kS/s, V")
def siglent_converted(line: Line) -> str:
    told = ("Record Length,Analog:8000", f"Sample Rate,{RATE_HZ}", "Vertical Scale,CH1: 0.05")
    return text(*told, "Second,Volt,Volt", rows=line.rows("{t:.11f},{v:.5f},{w:.5f}"))


@layout("LeCroy", "channel 1 of 1 (Ampl), 160 kS/s, V, as no unit is named")
def lecroy(line: Line) -> str:
    told = ("LECROYWS424,12345,Waveform", f"Segments,1,SegmentSize,{len(line.t)}")
    more = ("Segment,TrigTime,TimeSinceSegment1", "#1,26-Feb-2007 14:02:32,0", "Time,Ampl")
    return text(*told, *more, rows=line.rows("{t:.6g},{v:.5g}"), end="\r\n")


@layout("LeCroy WaveJet", "channel 1 of 2 (Ch1 V), 160 kS/s, V")
def lecroy_wavejet(line: Line) -> str:
    told = ("Model,WaveJet 354A", f"Delta(second),{1 / RATE_HZ:.4e}", "Trigger Address,320")
    return text(*told, "Ch1 V,Ch2 V", rows=line.rows("{v:.5f},{w:.5f}"))


@layout("PicoScope", "channel 1 of 2 (Channel A (mV)), 160 kS/s, mV")
def picoscope(line: Line) -> str:
    ms = Line(line.t * 1e3, line.v * 1e3, line.w)
    rows = ms.rows("{t:.8f},{v:.8f},{w:.8f}")
    rows[5], rows[6] = (row.split(",")[0] + ",\u221e,-\u221e" for row in rows[5:7])
    return text("Time,Channel A,Channel B", "(ms),(mV),(V)", ",,", rows=rows)


@layout("PicoScope, German", "channel 1 of 1 (Kanal A (mV)), 160 kS/s, mV")
def picoscope_german(line: Line) -> str:
    us = Line(line.t * 1e6, line.v * 1e3, line.w)
    rows = [row.replace(".", ",") for row in us.rows("{t:.8f};{v:.8f}")]
    return text("Zeit;Kanal A", "(\u00b5s);(mV)", "", rows=rows, end="\r\n")


@layout("Saleae", "channel 1 of 2 (Channel 0), 160 kS/s, V, as no unit is named")
def saleae(line: Line) -> str:
    rows = line.rows("{t:.9f},{v:.9f},{w:.9f}")
    return text("\ufeffTime [s],Channel 0,Channel 1", rows=rows)


@layout("Digilent WaveForms", "channel 1 of 2 (Channel 1 (V)), 160 kS/s, V")
def digilent(line: Line) -> str:
    told = ("#Digilent WaveForms Oscilloscope Acquisition", "#Device Name: Discovery2")
    more = ("#Date Time: 2026-04-19 10:00:00.0", f"#Sample rate: {RATE_HZ:.0f}Hz", "#Samples: 8")
    heading = "Time (s),Channel 1 (V),Channel 2 (V)"
    return text(*told, *more, "", heading, rows=line.rows("{t:.9f},{v:.6f},{w:.6f}"))


@layout("OWON", "channel 1 of 2 (CH1_Voltage(mV)), 160 kS/s, mV")
def owon(line: Line) -> str:
    told = ("Channel :,CH1(B),CH2(B)", "Frequency :,F=1.498kHz,F=?", "Average :,V=-9.3mV,V=1V")
    interval, heading = f"{1e6 / RATE_HZ:.5f}uS,6.2uS", "index,CH1_Voltage(mV),CH2_Voltage(mV)"
    rows = Line(line.t, line.v * 1e3, line.w * 1e3).rows("{i},{v:.2f},{w:.2f}")
    return text(*told, f"Time interval :,{interval}", "", heading, heading, rows=rows)


@layout("sigrok", "channel 1 of 2 (V DC), 160 kS/s, V")
def sigrok(line: Line) -> str:
    told = ("; CSV generated by libsigrok 0.5.2 on Fri Apr 19 10:00:00 2026",)
    told += ("; Channels (2/8): A0, A1",)
    return text(*told, "; Samplerate: 160 kHz", "V DC,V DC", rows=line.rows("{v:g},{w:g}"))


@layout("Hantek", "channel 1 of 1, 160 kS/s, V, as no unit is named")
def hantek(line: Line) -> str:
    rows = line.rows("{t:.5E},{v:.3f}")
    return text("#timebase=2000000000(ps)", ",#voltbase=5000000(uV)", "#size=8000", rows=rows)


def write_lines(path: Path, content: str, encoding: str = "utf-8") -> Path:
    path.write_text(content, encoding=encoding, newline="")
    return path


def decoded(path: Path, printed: Printed, *options: str) -> tuple[list, str]:
    """Codes and start of each frame, and what was said."""
    out, err = printed("decode", path, "--timing", "gap", "--json", *options)
    frames = [json.loads(row) for row in out.splitlines()]
    return [([node["code"] for node in f["nodes"]], f["t"]) for f in frames], err


def check(frames: list, start_s: float = START_S) -> None:
    assert [codes for codes, _ in frames] == [CODES.tolist()] * FRAMES
    starts = start_s + 1e-3 + 12.8e-3 * np.arange(FRAMES)
    assert [t for _, t in frames] == pytest.approx(starts, abs=1e-5)


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_words_in_every_makers_file_are_those_on_the_line(
    tmp_path: Path, printed: Printed, line: Line, name: str
) -> None:
    writer, taken = LAYOUTS[name]
    frames, said = decoded(write_lines(tmp_path / "scope.csv", writer(line)), printed)
    check(frames, 0 if name in WITHOUT_START else START_S)
    assert f"scope.csv: {taken}\n" in said


@pytest.mark.parametrize(
    ("writer", "encoding", "zeros"),
    [
        (picoscope, "utf-16", ""),
        (picoscope, "utf-8-sig", "\0"),
        (picoscope_german, "latin-1", "\0"),
    ],
)
def test_encodings_zeros_and_lines_at_the_end_do_not_matter(
    tmp_path: Path, printed: Printed, line: Line, writer: Writer, encoding: str, zeros: str
) -> None:
    content = writer(line).replace("\n", f"{zeros}\n") + "\n;;\nEnde der Messung: 100 %\n"
    path = write_lines(tmp_path / "scope.csv", content + 5000 * zeros, encoding)
    check(decoded(path, printed)[0])


@pytest.mark.parametrize("form", ["{v:.6f}", "{v:.6f},{w:.6f}", "{i},{v:.6f}"])
def test_a_file_of_values_needs_a_rate_from_the_user_or_the_file_beside_it(
    tmp_path: Path, printed: Printed, refused: Refused, line: Line, form: str
) -> None:
    path = write_lines(tmp_path / "touch.Wfm.csv", text(rows=line.rows(form)))
    assert "no rate in the header: give --rate" in refused("decode", path)
    check(decoded(path, printed, "--rate", "160e3")[0], 0)
    beside = f"XStart:{START_S}:\nSignalResolution:{1 / RATE_HZ:.6e}:\n"
    write_lines(tmp_path / "touch.csv", beside)
    check(decoded(path, printed)[0])


@pytest.mark.parametrize("channel", ["2", "CH2", "ch2 volt"])
def test_a_channel_is_chosen_by_number_or_heading(
    tmp_path: Path, printed: Printed, line: Line, channel: str
) -> None:
    path = write_lines(tmp_path / "scope.csv", rigol_old(Line(line.t, line.w, line.v)))
    frames, said = decoded(path, printed, "--channel", channel)
    check(frames)
    assert "channel 2 of 2 (CH2 Volt)" in said


def test_a_heading_counts_more_than_a_number(tmp_path: Path, line: Line) -> None:
    path = write_lines(tmp_path / "scope.csv", saleae(line))
    assert "channel 2 of 2 (Channel 1)" in read_scope_csv(path, "1").taken


def test_times_of_whole_microseconds_are_refused_until_the_rate_is_told(
    tmp_path: Path, printed: Printed, refused: Refused, line: Line
) -> None:
    rows = [f"{6 * i},{v:g}" for i, v in enumerate(line.v)]  # sigrok rounds 6.25 down
    del rows[3000:3020]
    content = text("; Samplerate: 160 kHz", "microseconds,V DC", rows=rows)
    path = write_lines(tmp_path / "scope.csv", content)
    assert "166.7 kS/s by its times, 160 kS/s by its header" in refused("decode", path)
    frames, said = decoded(path, printed, "--rate", "160000")
    assert frames == [(CODES.tolist(), pytest.approx(t, abs=1e-5)) for t in (1e-3, 26.6e-3)]
    assert "160 kS/s" in said and "samples are missing in 1 places" in said


@pytest.mark.parametrize(
    ("header", "form", "options", "message"),
    [
        ("Time (ms),CH1 (V)", "{t:.7f},{v:.5f}", [], "no frame found"),
        ("Time (s),CH1 (V)", "{i}.0,{v:.5f}", [], "3 or more are needed"),
        ("Sequence,CH1", "{i},{v:.5f}", [], "no rate in the header"),
        ("Time,CH1", "{i},{v:.5f}", [], "no rate in the header"),
        ("CH1 (V),CH2 (V)", "{t:.7f},{v:.5f}", [], "no rate in the header"),
        ("", "{v:.5f},{w:.5f}", [], "no rate in the header"),
        ("Time (s)", "{t:.7f}", [], "no column of voltages"),
        ("Time,CH1", "{t:.7f},{v:.5f} V", [], "no column of voltages"),
        ("Time,CH1", "{t:.7f},{v:.5f}", ["--channel", "2"], "no single channel '2' among 1"),
        ("Time,CH1,CH1", "{t:.7f},{v:f},{w:f}", ["--channel", "CH1"], "no single channel 'CH1'"),
        ("Time,CH1,CH2", "{t:.7f},{v:f},{w:f}", ["--channel", "2"], "no frame found"),
    ],
)
def test_a_wrong_guess_is_refused(
    tmp_path: Path,
    printed: Printed,
    line: Line,
    header: str,
    form: str,
    options: list[str],
    message: str,
) -> None:
    path = write_lines(tmp_path / "scope.csv", text(header, rows=line.rows(form)))
    out, err = printed("decode", path, *options, code=1)
    assert out == ""
    assert message in err.splitlines()[-1]


@pytest.mark.parametrize("options", [[], ["--rate", "160e3"]])
def test_commas_that_separate_and_are_decimal_are_refused(
    tmp_path: Path, printed: Printed, line: Line, options: list[str]
) -> None:
    rows = Line(line.t * 1e3, line.v, line.w).rows("{t:.6f},{v:.5f}")
    content = text("Time (ms),CH1 (V)", rows=[row.replace(".", ",") for row in rows])
    path = write_lines(tmp_path / "scope.csv", content)
    assert printed("decode", path, *options, code=1).out == ""


def test_options_for_scopes_are_refused_for_recordings(
    tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    path = tmp_path / "touch.skin"
    printed("record", "sim://?speed=2", path, "--seconds", 0.2)
    assert "are for an oscilloscope's CSV" in refused("decode", path, "--rate", "1e6")


def test_zeros_at_the_end_of_text_are_no_raw_bytes(tmp_path: Path) -> None:
    path = tmp_path / "any"
    for content, expected in ((b"1,2\n\0\0", True), (b"\0\0", False), (b"1,2\n\0\x02", False)):
        path.write_bytes(content)
        assert is_text(path) is expected


def test_a_long_file_is_passed_over_few_times_and_its_lines_left_to_numpy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passed = itertools.count()

    def lines(text: str) -> Iterator[str]:
        return (line for line in lines_of(text) if next(passed) >= 0)

    looks = mock.Mock(wraps=scope_csv._fields)
    monkeypatch.setattr(scope_csv, "lines_of", lines)
    monkeypatch.setattr(scope_csv, "_fields", looks)
    rows = [f"{i * 1e-6:.6f},{(i % 97) / 97:.4f},," for i in range(100_000)]
    path = write_lines(tmp_path / "long.csv", text("Time (s),CH1 (V),,", rows=rows))
    assert read_scope_csv(path).rate_hz == pytest.approx(1e6)
    assert len(rows) < next(passed) < 4.5 * len(rows)
    assert 0 < looks.call_count < 1500
