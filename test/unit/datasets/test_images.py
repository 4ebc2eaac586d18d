# SPDX-License-Identifier: Apache-2.0

"""Camera messages as files: the same pixels, whatever their encoding."""

import io
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.datasets.sources.images import (
    check_size,
    decoded,
    depth,
    encoded,
    is_depth,
    problem,
)

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


def compressed(pixels: Any, format_: str = "PNG", header: bytes = b"") -> Any:
    """A CompressedImage message."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format_)
    data = np.frombuffer(header + file.getvalue(), dtype=np.uint8)
    return SimpleNamespace(format=format_, data=data)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", RAW)
def test_pixels_are_those_of_the_message(encoding: str, padding: int) -> None:
    rows, expected = RAW[encoding]
    file = encoded(image(encoding, rows, padding), "/camera")
    assert (np.asarray(Image.open(io.BytesIO(file))) == expected).all()
    assert (decoded(file, "/camera") == expected).all()


def test_bayer_patterns_are_those_of_their_names() -> None:
    """One colour everywhere: each pixel of the mosaic holds the part that the name says."""
    pytest.importorskip("cv2")
    colour = dict(zip("rgb", (200, 90, 30), strict=True))
    for pattern in ("rggb", "bggr", "gbrg", "grbg"):
        mosaic = np.tile(np.reshape([colour[c] for c in pattern], (2, 2, 1)), (4, 4, 1))
        message = image(f"bayer_{pattern}8", mosaic.astype(np.uint8), padding=3)
        pixels = decoded(encoded(message, "/camera"), "/camera")
        assert (pixels == list(colour.values())).all()


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21"])
def test_brightness_and_colour_are_separated(encoding: str) -> None:
    """By the equations of ITU-R BT.601 in 8 bits, for an image of one colour."""
    pytest.importorskip("cv2")
    y, u, v = 120, 90, 180
    c, d, e = y - 16, u - 128, v - 128
    expected = [1.164 * c + 1.596 * e, 1.164 * c - 0.392 * d - 0.813 * e, 1.164 * c + 2.017 * d]
    if encoding.startswith("nv"):
        pair = [u, v] if encoding == "nv12" else [v, u]
        rows = np.full((6, 8, 1), y, np.uint8)
        rows[4:] = np.tile(pair, 4)[:, None]
        message = image(encoding, rows, padding=2)
        message.height = 4
    else:
        four = [u, y, v, y] if encoding in ("yuv422", "uyvy") else [y, u, y, v]
        message = image(encoding, np.tile(four, (4, 4)).reshape(4, 8, 2).astype(np.uint8), 2)
    pixels = decoded(encoded(message, "/camera"), "/camera")
    assert pixels.shape == (4, 8, 3) and np.abs(pixels - np.array(expected)).max() < 2
    message.data = message.data[:-3]
    with pytest.raises(CaptureError, match="/camera: an image of 8 × 4 with"):
        encoded(message, "/camera")


@pytest.mark.parametrize("big_endian", [False, True])
def test_depths_are_exact(big_endian: bool) -> None:
    millimetres = RNG.integers(0, 65536, (5, 7)).astype(np.uint16)
    metres = np.where(millimetres < 9000, np.nan, millimetres * 1e-3).astype(np.float32)
    for encoding, numbers in (("16UC1", millimetres), ("mono16", millimetres), ("32FC1", metres)):
        raw = numbers.astype(numbers.dtype.newbyteorder(">" if big_endian else "<"))
        message = image(encoding, raw[:, :, None].view(np.uint8), padding=4)
        message.is_bigendian = big_endian
        assert is_depth(message) and problem(message) is None
        found = depth(message, "/depth")
        assert found.dtype == numbers.dtype and np.array_equal(found, numbers, equal_nan=True)
    message = compressed(millimetres, header=bytes(12))
    message.format = "16UC1; compressedDepth png"
    assert problem(message) is None and (depth(message, "/depth") == millimetres).all()
    message.format = "32FC1; compressedDepth png"  # of which 16 bits are left
    with pytest.raises(CaptureError, match="/depth: format '32FC1; compressedDepth png'"):
        depth(message, "/depth")


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_compressed_images_stay_as_they_are(kind: str) -> None:
    message = compressed(PIXELS, kind)
    assert encoded(message, "/camera") == bytes(message.data)


def test_what_is_no_image_is_named() -> None:
    other = image("8SC2", PIXELS[:, :, :2])
    assert "encoding 8SC2" in str(problem(other))
    short = image("rgb8", PIXELS)
    short.data = short.data[:-1]
    nothing = image("rgb8", PIXELS[:0])
    video = SimpleNamespace(format="h264", data=np.zeros(20, dtype=np.uint8))
    for message in (other, short, nothing, video):
        with pytest.raises(CaptureError, match="/camera"):
            encoded(message, "/camera")
    with pytest.raises(CaptureError, match="/camera"):
        decoded(b"\x89PNG\r\n\x1a\n and no more", "/camera")


def test_another_size_is_told() -> None:
    said = "/camera: an image of 7 × 5 pixels after others of 5 × 7"
    for message in (image("rgb8", PIXELS), compressed(PIXELS)):
        check_size(message, "/camera", (5, 7, 3))
        with pytest.raises(CaptureError, match=said):
            check_size(message, "/camera", (7, 5, 3))
    message.data = message.data[:20]
    with pytest.raises(CaptureError, match="/camera: an image that cannot be read"):
        check_size(message, "/camera", (5, 7, 3))
