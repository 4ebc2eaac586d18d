# SPDX-License-Identifier: Apache-2.0

"""Videos and figures of a skin, looked at by other libraries: the colours of pressure, or grey."""

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.datasets.pictures import binned, interrupted
from tactile_cdma.views.heatmap import NO_READING_RGB, colours
from test.support.bags import TAXELS, BagMaker, pressure_pa
from test.support.command_line import Printed, Refused

pytestmark = pytest.mark.xdist_group("datasets")
SECONDS, MAX_KPA = 2.4, 40
GREY = np.array(NO_READING_RGB)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Taxel 5 is pressed, but not read; from 1 s on there are no frames for 0.9 s."""
    maker = BagMaker().skin("/skin", SECONDS, lambda _: [5])
    messages = maker.of("/skin/tactile")
    lost = [i for i, one in enumerate(messages) if 1.0 < one.device_time_us * 1e-6 < 1.9]
    return maker.without("/skin/tactile", *lost).write(tmp_path_factory.mktemp("film") / "session")


def pictures(path: Path) -> tuple[list[NDArray[np.uint8]], float]:
    """All pictures of a video, and its length, s, by the library that did not write it."""
    if path.suffix == ".gif":
        av = pytest.importorskip("av", reason="the extra [plot] is not installed")
        with av.open(path) as film:
            shown = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
            return shown, float(film.duration) / 1e6
    cv2 = pytest.importorskip("cv2", reason="the extra [learn] is not installed")
    film = cv2.VideoCapture(str(path))
    shown = []
    while (read := film.read())[0]:
        shown.append(read[1][:, :, ::-1])
    return shown, len(shown) / film.get(cv2.CAP_PROP_FPS)


def centres(picture: NDArray[np.uint8]) -> NDArray[np.int64]:
    """The colours of the 16 taxels, 7 mm apart in a row, and 28 mm from row to row."""
    down, across = np.arange(60, 480, 120), np.arange(15, 120, 30)
    return picture[np.ix_(down, across)].reshape(TAXELS, 3).astype(int)


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_video_shows_pressure_at_its_time_and_grey_where_nothing_is_known(
    bag: Path, tmp_path: Path, printed: Printed, suffix: str
) -> None:
    pytest.importorskip("av", reason="the extra [plot] is not installed")
    path = tmp_path / f"out.{suffix}"
    printed("export", bag, "--video", path, "--max-kpa", MAX_KPA)
    shown, length_s = pictures(path)
    assert length_s == pytest.approx(SECONDS, abs=0.15)
    for share in (0.1, 0.3, 0.95):
        picture = shown[int(share * len(shown))]
        expected = colours(pressure_pa(share * length_s).astype(np.float32), MAX_KPA * 1e3)
        expected[5] = GREY
        assert np.abs(centres(picture) - expected).max() < 40, share
    # Half a second after the last frame nothing counts any more, though all are pressed.
    assert np.abs(centres(shown[int(1.7 / SECONDS * len(shown))]) - GREY).max() < 12


def test_a_figure_shows_every_taxel_over_time_and_gaps_as_gaps(
    bag: Path, tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    path = tmp_path / "out.png"
    said = printed("plot", bag, "-o", path).out
    assert said.startswith("frames=117 missing_frames=70 taxels=16 ")
    pixels = (matplotlib.image.imread(path)[..., :3] * 255).round().astype(int)
    grey = (np.abs(pixels - GREY) <= 2).all(axis=2)[: len(pixels) // 2]  # the upper half
    gap = np.flatnonzero(grey.mean(axis=0) > 0.7)  # 0.9 of 2.4 s, all taxels
    assert 0.25 < len(gap) / pixels.shape[1] < 0.35 and np.ptp(gap) == len(gap) - 1
    row = np.flatnonzero(grey.mean(axis=1) > 0.7)  # taxel 5 of 16
    assert 15 < len(row) < 30 and np.ptp(row) == len(row) - 1
    for name in ("out.pdf", "out.svg"):
        printed("plot", bag, "-o", tmp_path / name, "--start", "0.1", "--end", "0.5")
    assert (tmp_path / "out.pdf").read_bytes().startswith(b"%PDF")
    assert "--max-kpa is for pictures" in refused(
        "export", bag, "-o", tmp_path / "out.npz", "--max-kpa", "3"
    )


def test_a_peak_stays_visible_and_a_gap_is_no_line() -> None:
    t_s = np.array([0.0, 0.1, 0.2, 0.3, 0.9, 1.0])
    values = np.array([[1.0], [9.0], [np.nan], [2.0], [np.nan], [3.0]])
    assert np.array_equal(
        binned(t_s, values, 4)[:, 0], np.array([9.0, 2.0, np.nan, 3.0]), equal_nan=True
    )
    times_s, curve = interrupted(t_s, np.arange(6.0))
    assert np.flatnonzero(np.isnan(times_s)).tolist() == [4]
    assert np.flatnonzero(np.isnan(curve)).tolist() == [4]
