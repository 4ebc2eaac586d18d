# SPDX-License-Identifier: Apache-2.0

"""Reading oscilloscope captures."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.recording.recording_file import is_text
from tactile_cdma.recording.scope_csv import read_scope_csv

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


def test_coarse_time_stamps_give_the_exact_mean_rate(tmp_path: Path) -> None:
    time_s = np.round(np.arange(20_000) * 5e-6, 6)
    lines = [f"{t:.6f},{0.1}" for t in time_s]
    capture = read_scope_csv(write(tmp_path / "scope.csv", lines))
    assert len(capture.pieces) == 1
    assert capture.rate_hz == pytest.approx(200e3, rel=1e-4)


def test_times_of_few_digits_are_taken_as_evenly_spaced(tmp_path: Path) -> None:
    lines = [f"{t:.3e},{v:.4f}" for t, v in zip(0.1 + np.arange(400) * 5e-6, VOLTS, strict=True)]
    capture = read_scope_csv(write(tmp_path / "scope.csv", lines))
    assert len(capture.pieces) == 1
    assert capture.rate_hz == pytest.approx(200e3, rel=0.06)


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
