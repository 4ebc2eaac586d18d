# SPDX-License-Identifier: Apache-2.0

"""Camera messages: colours as PNG, compressed ones as they are, depths as exact arrays."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.errors import CaptureError, needed_for

ENCODINGS = {
    "rgb8": (3, (0, 1, 2)),
    "8UC3": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
"""Encodings of sensor_msgs/Image that are taken: bytes of a pixel; its red, green and blue."""
CONVERTED = {
    "yuv422": (2, "YUV2RGB_UYVY"),
    "uyvy": (2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "YUV2RGB_YUYV"),
    "yuyv": (2, "YUV2RGB_YUYV"),
    "nv12": (1, "YUV2RGB_NV12"),
    "nv21": (1, "YUV2RGB_NV21"),
    "bayer_rggb8": (1, "BayerRGGB2RGB"),
    "bayer_bggr8": (1, "BayerBGGR2RGB"),
    "bayer_gbrg8": (1, "BayerGBRG2RGB"),
    "bayer_grbg8": (1, "BayerGRBG2RGB"),
}
"""Encodings that OpenCV converts: bytes of a pixel in a row, name of the conversion."""
DEPTHS = {"16UC1": ("uint16", "mm"), "mono16": ("uint16", ""), "32FC1": ("float32", "m")}
"""Encodings that are kept as they are: numpy's type, unit (REP 118)."""
COMPRESSED_DEPTH, HEADER_BYTES = "compressedDepth", 12
"""A word in the format of compressed depths; bytes that image_transport puts before their PNG."""
PNG_LEVEL = 1
"""Effort of compression; chosen: 6 takes three times as long for some 5 % less."""
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"


def problem(message: Any) -> str | None:
    """Say why an Image or CompressedImage cannot ride along; None if it can."""
    if hasattr(message, "encoding"):
        taken = (*ENCODINGS, *CONVERTED, *DEPTHS)
        if message.encoding in taken:
            return None
        return f"encoding {message.encoding}; {', '.join(taken)} are taken"
    if is_depth(message):
        if message.format.startswith("16UC1") and _file(message).startswith(_PNG):
            return None
        return f"format {message.format!r}: compressed depths are taken as PNG of 16UC1"
    if _file(message).startswith((_PNG, _JPEG)):
        return None
    return f"format {message.format!r} is neither PNG nor JPEG"


def is_depth(message: Any) -> bool:
    """Tell whether an image holds numbers, which are kept exactly, in place of colours."""
    if hasattr(message, "encoding"):
        return message.encoding in DEPTHS
    return COMPRESSED_DEPTH in message.format


def depth(message: Any, topic: str) -> NDArray[Any]:
    """Return the numbers of an image that is_depth(), (height, width). Raises CaptureError."""
    if (reason := problem(message)) is not None:
        raise CaptureError(f"{topic}: {reason}")
    if not hasattr(message, "encoding"):
        with _opened(_file(message), topic) as image:
            return np.asarray(image).astype(np.uint16)
    kind = np.dtype(DEPTHS[message.encoding][0])
    rows = _rows(message, topic, int(message.height), int(message.width) * kind.itemsize)
    return rows.view(kind.newbyteorder(">" if message.is_bigendian else "<")).astype(kind)


def encoded(message: Any, topic: str) -> bytes:
    """Make the image a PNG or JPEG file. Raises CaptureError, with the topic, for a broken one."""
    if (reason := problem(message)) is not None:
        raise CaptureError(f"{topic}: {reason}")
    if not hasattr(message, "encoding"):
        return _file(message)
    with needed_for("an image", "PIL", "pillow"):
        from PIL import Image

    file = io.BytesIO()
    Image.fromarray(_pixels(message, topic)).save(file, "PNG", compress_level=PNG_LEVEL)
    return file.getvalue()


def check_size(message: Any, topic: str, shape: tuple[int, ...]) -> None:
    """Raises CaptureError for an image that is not as its first: (height, width, …), or a depth."""
    if is_depth(message) != (len(shape) == 2):
        raise CaptureError(f"{topic}: depths and colours alternate: choose by --start and --end")
    if hasattr(message, "encoding"):
        width, height = message.width, message.height
    else:
        with _opened(_file(message), topic) as image:  # reads the header, no pixels
            width, height = image.size
    if (height, width) != shape[:2]:
        raise CaptureError(
            f"{topic}: an image of {width} × {height} pixels after others of "
            f"{shape[1]} × {shape[0]}: a dataset has one size; choose by --start and --end"
        )


def decoded(file: bytes, topic: str) -> NDArray[np.uint8]:
    """Decode an image to (height, width, 3) pixels. Raises CaptureError for a broken one."""
    with _opened(file, topic) as image:
        return np.asarray(image.convert("RGB"))


@contextmanager
def _opened(file: bytes, topic: str) -> Iterator[Any]:
    """Open an encoded image; raises CaptureError for a broken one, then or when it is read."""
    with needed_for("an image", "PIL", "pillow"):
        from PIL import Image
    try:
        with Image.open(io.BytesIO(file), formats=("PNG", "JPEG")) as image:
            yield image
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{topic}: an image that cannot be read: {error}") from None


def _file(message: Any) -> bytes:
    return bytes(message.data)[HEADER_BYTES if is_depth(message) else 0 :]


def _pixels(message: Any, topic: str) -> NDArray[np.uint8]:
    """Return red, green and blue of an Image, (height, width, 3)."""
    height, width = int(message.height), int(message.width)
    if message.encoding in ENCODINGS:
        size, channels = ENCODINGS[message.encoding]
        rows = _rows(message, topic, height, width * size)
        return np.ascontiguousarray(rows.reshape(height, width, size)[:, :, channels])
    with needed_for(f"{topic}, encoded as {message.encoding},", "cv2", "opencv-python-headless"):
        import cv2
    size, name = CONVERTED[message.encoding]
    lines = height * 3 // 2 if "NV" in name else height  # below the brightness half as many colours
    rows = _rows(message, topic, lines, width * size)
    try:
        return cv2.cvtColor(rows.reshape(lines, width, size), getattr(cv2, f"COLOR_{name}"))  # type: ignore[return-value]
    except cv2.error as error:  # a size that such images cannot have
        raise CaptureError(f"{topic}: {width} × {height} pixels: {error.err}") from None


def _rows(message: Any, topic: str, lines: int, size: int) -> NDArray[np.uint8]:
    """Return the (lines, size) bytes of an Image without its rows' padding; raises CaptureError."""
    step = int(message.step)
    if step < size or len(message.data) < step * lines or not lines * size:
        raise CaptureError(
            f"{topic}: an image of {message.width} × {message.height} with {len(message.data)} "
            "bytes"
        )
    rows = np.asarray(message.data[: step * lines], dtype=np.uint8).reshape(lines, step)
    return np.ascontiguousarray(rows[:, :size])
