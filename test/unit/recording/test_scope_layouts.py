# SPDX-License-Identifier: Apache-2.0

"""One line, written as each maker's oscilloscope would, is decoded to the words that were sent.

The layouts are those of the makers' manuals and of files in public repositories.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.recording.recording_file import is_text
from tactile_cdma.recording.scope_csv import read_scope_csv
from tactile_cdma.sim.channel import Channel
from test.support.command_line import Printed, Refused
from test.support.simulated import scope_capture

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


def write(path: Path, content: str, encoding: str = "utf-8") -> Path:
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
    frames, said = decoded(write(tmp_path / "scope.csv", writer(line)), printed)
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
    tmp_path: Path,
    printed: Printed,
    line: Line,
    writer: Writer,
    encoding: str,
    zeros: str,
) -> None:
    content = writer(line).replace("\n", f"{zeros}\n") + "\n;;\nEnde der Messung: 100 %\n"
    path = write(tmp_path / "scope.csv", content + 5000 * zeros, encoding)
    check(decoded(path, printed)[0])


@pytest.mark.parametrize("form", ["{v:.6f}", "{v:.6f},{w:.6f}", "{i},{v:.6f}"])
def test_a_file_of_values_needs_a_rate_from_the_user_or_the_file_beside_it(
    tmp_path: Path, printed: Printed, refused: Refused, line: Line, form: str
) -> None:
    path = write(tmp_path / "touch.Wfm.csv", text(rows=line.rows(form)))
    assert "no rate in the header: tell it by --rate" in refused("decode", path)
    check(decoded(path, printed, "--rate", "160e3")[0], 0)
    beside = f"XStart:{START_S}:\nSignalResolution:{1 / RATE_HZ:.6e}:\n"
    write(tmp_path / "touch.csv", beside)
    check(decoded(path, printed)[0])


@pytest.mark.parametrize("channel", ["2", "CH2", "ch2 volt"])
def test_a_channel_is_chosen_by_number_or_heading(
    tmp_path: Path, printed: Printed, line: Line, channel: str
) -> None:
    path = write(tmp_path / "scope.csv", rigol_old(Line(line.t, line.w, line.v)))
    frames, said = decoded(path, printed, "--channel", channel)
    check(frames)
    assert "channel 2 of 2 (CH2 Volt)" in said


def test_a_heading_counts_more_than_a_number(tmp_path: Path, line: Line) -> None:
    path = write(tmp_path / "scope.csv", saleae(line))
    assert "channel 2 of 2 (Channel 1)" in read_scope_csv(path, "1").taken


def test_times_of_whole_microseconds_are_refused_until_the_rate_is_told(
    tmp_path: Path, printed: Printed, refused: Refused, line: Line
) -> None:
    rows = [f"{6 * i},{v:g}" for i, v in enumerate(line.v)]  # sigrok rounds 6.25 down
    del rows[3000:3020]
    content = text("; Samplerate: 160 kHz", "microseconds,V DC", rows=rows)
    path = write(tmp_path / "scope.csv", content)
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
    path = write(tmp_path / "scope.csv", text(header, rows=line.rows(form)))
    out, err = printed("decode", path, *options, code=1)
    assert out == ""
    assert message in err.splitlines()[-1]


@pytest.mark.parametrize("options", [[], ["--rate", "160e3"]])
def test_commas_that_separate_and_are_decimal_are_refused(
    tmp_path: Path, printed: Printed, line: Line, options: list[str]
) -> None:
    rows = Line(line.t * 1e3, line.v, line.w).rows("{t:.6f},{v:.5f}")
    content = text("Time (ms),CH1 (V)", rows=[row.replace(".", ",") for row in rows])
    path = write(tmp_path / "scope.csv", content)
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


def test_a_long_file_costs_little_more_than_its_numbers(tmp_path: Path) -> None:
    rows = [f"{i * 1e-6:.6f},{(i % 97) / 97:.4f},," for i in range(100_000)]
    path = write(tmp_path / "long.csv", text("Time (s),CH1 (V),,", rows=rows))
    ratios = []
    for _ in range(9):  # by turns: a processor's speed changes
        begun = process_time()
        np.loadtxt(rows, delimiter=",", usecols=[0, 1], comments=None)
        parsed = process_time()
        assert read_scope_csv(path).rate_hz == pytest.approx(1e6)
        ratios.append((process_time() - parsed) / (parsed - begun))
    assert np.median(ratios) < 4
