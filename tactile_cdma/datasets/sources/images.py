# SPDX-License-Identifier: Apache-2.0

"""Camera messages as the bytes of image files: PNG of plain images, compressed ones as they are."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.errors import CaptureError

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
PNG_LEVEL = 1
"""Effort of compression; chosen: 6 takes three times as long for some 5 % less."""
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"


def problem(message: Any) -> str | None:
    """Why an Image or CompressedImage cannot ride along; None if it can."""
    if hasattr(message, "encoding"):
        if message.encoding in ENCODINGS:
            return None
        return f"encoding {message.encoding}; {', '.join(ENCODINGS)} are taken"
    if bytes(message.data[:8]).startswith((_PNG, _JPEG)):
        return None
    return f"format {message.format!r} is neither PNG nor JPEG"


def encoded(message: Any, topic: str) -> bytes:
    """The image as a PNG or JPEG file. Raises CaptureError, naming the topic, for a broken one."""
    if (reason := problem(message)) is not None:
        raise CaptureError(f"{topic}: {reason}")
    if not hasattr(message, "encoding"):
        return bytes(message.data)
    from PIL import Image  # slow to load, and needed here only

    file = io.BytesIO()
    Image.fromarray(_pixels(message, topic)).save(file, "PNG", compress_level=PNG_LEVEL)
    return file.getvalue()


def check_size(message: Any, topic: str, shape: tuple[int, ...]) -> None:
    """Raises CaptureError for an image of another size than its first: (height, width, 3)."""
    if hasattr(message, "encoding"):
        width, height = message.width, message.height
    else:
        with _opened(bytes(message.data), topic) as image:  # reads the header, no pixels
            width, height = image.size
    if (height, width) != shape[:2]:
        raise CaptureError(
            f"{topic}: an image of {width} × {height} pixels after others of "
            f"{shape[1]} × {shape[0]}: a dataset has one size; choose by --start and --end"
        )


def decoded(file: bytes, topic: str) -> NDArray[np.uint8]:
    """(height, width, 3) the pixels of an encoded image. Raises CaptureError for a broken one."""
    with _opened(file, topic) as image:
        return np.asarray(image.convert("RGB"))


@contextmanager
def _opened(file: bytes, topic: str) -> Iterator[Any]:
    """An encoded image; raises CaptureError for a broken one, then or when it is read."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(file), formats=("PNG", "JPEG")) as image:
            yield image
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{topic}: an image that cannot be read: {error}") from None


def _pixels(message: Any, topic: str) -> NDArray[np.uint8]:
    height, width, step = int(message.height), int(message.width), int(message.step)
    depth, channels = ENCODINGS[message.encoding]
    if step < width * depth or len(message.data) < step * height or not height * width:
        raise CaptureError(
            f"{topic}: an image of {width} × {height} with {len(message.data)} bytes"
        )
    rows = np.asarray(message.data[: step * height], dtype=np.uint8).reshape(height, step)
    pixels = rows[:, : width * depth].reshape(height, width, depth)
    return np.ascontiguousarray(pixels[:, :, channels])
