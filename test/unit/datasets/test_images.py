# SPDX-License-Identifier: Apache-2.0

"""Camera messages as files: the same pixels, whatever their encoding."""

import io
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.datasets.sources.images import check_size, decoded, encoded, problem

RNG = np.random.default_rng(1)
PIXELS = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)
GREY = np.repeat(PIXELS[:, :, :1], 3, axis=2)
ALPHA = np.full((5, 7, 1), 9, dtype=np.uint8)
RAW = {
    "rgb8": (PIXELS, PIXELS),
    "bgr8": (PIXELS[:, :, ::-1], PIXELS),
    "rgba8": (np.concatenate([PIXELS, ALPHA], axis=2), PIXELS),
    "bgra8": (np.concatenate([PIXELS[:, :, ::-1], ALPHA], axis=2), PIXELS),
    "mono8": (PIXELS[:, :, :1], GREY),
}


def image(encoding: str, rows: Any, padding: int = 0) -> Any:
    """An Image message with some bytes behind every row."""
    height, width, depth = rows.shape
    padded = np.full((height, width * depth + padding), 77, dtype=np.uint8)
    padded[:, : width * depth] = rows.reshape(height, width * depth)
    return SimpleNamespace(
        height=height, width=width, encoding=encoding, step=padded.shape[1], data=padded.ravel()
    )


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", RAW)
def test_pixels_are_those_of_the_message(encoding: str, padding: int) -> None:
    rows, expected = RAW[encoding]
    file = encoded(image(encoding, rows, padding), "/camera")
    assert (np.asarray(Image.open(io.BytesIO(file))) == expected).all()
    assert (decoded(file, "/camera") == expected).all()


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_compressed_images_stay_as_they_are(kind: str) -> None:
    file = io.BytesIO()
    Image.fromarray(PIXELS).save(file, kind)
    data = np.frombuffer(file.getvalue(), dtype=np.uint8)
    assert encoded(SimpleNamespace(format=kind, data=data), "/camera") == file.getvalue()


def test_what_is_no_image_is_named() -> None:
    depth = image("16UC1", PIXELS[:, :, :2])
    assert "encoding 16UC1" in str(problem(depth))
    short = image("rgb8", PIXELS)
    short.data = short.data[:-1]
    nothing = image("rgb8", PIXELS[:0])
    video = SimpleNamespace(format="h264", data=np.zeros(20, dtype=np.uint8))
    for message in (depth, short, nothing, video):
        with pytest.raises(CaptureError, match="/camera"):
            encoded(message, "/camera")
    with pytest.raises(CaptureError, match="/camera"):
        decoded(b"\x89PNG\r\n\x1a\n and no more", "/camera")


def test_another_size_is_told() -> None:
    file = io.BytesIO()
    Image.fromarray(PIXELS).save(file, "PNG")
    data = np.frombuffer(file.getvalue(), dtype=np.uint8)
    for message in (image("rgb8", PIXELS), SimpleNamespace(format="png", data=data)):
        check_size(message, "/camera", (5, 7, 3))
        with pytest.raises(
            CaptureError, match="/camera: an image of 7 × 5 pixels after others of 5 × 7"
        ):
            check_size(message, "/camera", (7, 5, 3))
    with pytest.raises(CaptureError, match="/camera: an image that cannot be read"):
        check_size(SimpleNamespace(format="png", data=data[:20]), "/camera", (5, 7, 3))
