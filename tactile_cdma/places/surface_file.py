# SPDX-License-Identifier: Apache-2.0

"""Triangles of a robot's part, from an STL or OBJ file or a link of a URDF, and rays on them."""

import io
import math
import re
from array import array
from collections.abc import Iterator
from contextlib import suppress
from itertools import accumulate, pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..base.arrays import Floats, Indices
from ..base.errors import LayoutError
from ..base.named_file import expanded, naming, read_named
from ..base.text import listed
from .poses import Pose

MOST_TRIANGLES = 1 << 19
"""Most triangles of a mesh. Chosen: far beyond robots'; a file may be another one by mistake."""
MOST_BYTES = 1 << 26
"""Largest file of a mesh; chosen: an OBJ file of MOST_TRIANGLES has 50 MB."""
MOST_URDF_BYTES = 1 << 21
"""Largest file of a robot; chosen: humanoids have 0.5 MB, and expat takes 100 times its size."""
MOST_PAIRS = 1 << 26
"""Most pairs of a taxel and a triangle near it; chosen: they take 10 s."""
_MOST_LINE = 1 << 16
"""Bytes of a line of an OBJ file; chosen: a face of 5,000 corners."""
_NO_CORNER = "a face of a corner that it does not have"
_STL_HEADER, _STL_FACET = 84, 50
_AT_ONCE = 1 << 15
"""Pairs of ray and triangle that are intersected at once; more are divided, by rays."""
_SIDES = 96
"""Sides of a polygon that stands for a circle, so that normals are off by 2° at most; chosen."""


def read_triangles(path: Path) -> Floats:
    """Read corners (n, 3, 3), anticlockwise seen from outside, in the file's unit.

    Raises ValueError where it is neither an STL nor an OBJ file, or is not readable.
    """
    if (make := _MAKERS.get(path.suffix.lower())) is None:
        raise ValueError(f"{path}: not an .stl or .obj file; convert it to one")
    try:
        triangles = make(_content(path, MOST_BYTES))
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path}: not a mesh: {error}") from None
    if not len(triangles):
        raise ValueError(f"{path}: has no triangles")
    return triangles


def read_link(urdf: Path, link: str) -> Floats:
    """Read triangles of a link's collision geometry, or its visual one, m, in the link's frame.

    Raises ValueError where there is none that can be read.
    """
    try:
        robot = ElementTree.fromstring(_content(urdf, MOST_URDF_BYTES))  # noqa: S314  (their own robot)
    except (ElementTree.ParseError, LookupError) as error:  # of an unknown encoding
        raise ValueError(f"{urdf}: not a URDF: {error}") from None
    links = {element.get("name"): element for element in robot.iter("link")}
    if link not in links:
        names = listed(sorted(name for name in links if name)) or "no links"
        raise ValueError(f"{urdf}: has no link {link!r}; it has {names}")
    for kind in ("collision", "visual"):
        parts, count = list[Floats](), 0
        for element in links[link].iter(kind):
            parts.append(_part(element, urdf, link))
            count += len(parts[-1])
            _check_count(count)
        if parts:
            return np.concatenate(parts)
    raise ValueError(f"{urdf}: link {link!r} has no geometry")


def first_hits(triangles: Floats, starts: Floats, way: Floats) -> tuple[Floats, Floats]:
    """Find where rays first meet triangles: distance (m,), ∞ if nowhere, and normal (m, 3).

    triangles: (n, 3, 3). starts: (m, 3). way: unit vector. (Möller & Trumbore, Fast, minimum
    storage ray/triangle intersection, 1997.)
    """
    corner = triangles[:, 0]
    one, other = triangles[:, 1] - corner, triangles[:, 2] - corner
    across = np.cross(way, other)
    det = np.einsum("ni,ni->n", one, across)
    usable = np.abs(det) > 1e-12 * np.maximum(np.linalg.norm(np.cross(one, other), axis=1), 1e-30)
    corner, one, other, across, det = (x[usable] for x in (corner, one, other, across, det))
    distance, normals = np.full(len(starts), np.inf), np.zeros((len(starts), 3))
    if not len(corner):
        return distance, normals
    out = np.cross(one, other)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    # Seen along the rays, where triangles begin and end: a ray meets only those around its start.
    flat = np.linalg.svd(way[None])[2][1:].T
    corners, at = np.stack([corner, corner + one, corner + other]) @ flat, starts @ flat
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 1e-6 * (high.max(axis=0) - low.min(axis=0))

    def parts() -> Iterator[tuple[int, int, Indices]]:
        """Yield ranges of rays, each with the triangles around them."""
        todo = [(0, len(starts), np.arange(len(corner)))]
        while todo:
            begin, stop, near = todo.pop()
            least, most = at[begin:stop].min(axis=0) - margin, at[begin:stop].max(axis=0) + margin
            near = near[((low[near] <= most) & (high[near] >= least)).all(axis=1)]
            middle = (begin + stop) // 2
            if (stop - begin) * len(near) > _AT_ONCE and middle > begin:
                todo += [(begin, middle, near), (middle, stop, near)]
            elif len(near):
                yield begin, stop, near

    pairs = accumulate((stop - begin) * len(near) for begin, stop, near in parts())
    if any(count > MOST_PAIRS for count in pairs):
        raise ValueError(f"too many triangles for {len(starts)} taxels; export a coarser mesh")
    for begin, stop, near in parts():
        offset = starts[begin:stop, None] - corner[near]
        u = np.einsum("mni,ni->mn", offset, across[near]) / det[near]
        turned = np.cross(offset, one[near])
        v = turned @ way / det[near]
        reach = np.einsum("mni,ni->mn", turned, other[near]) / det[near]
        hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (reach >= 0)
        reach = np.where(hit, reach, np.inf)
        nearest = reach.argmin(axis=1)
        distance[begin:stop] = reach[np.arange(len(nearest)), nearest]
        normals[begin:stop] = out[near[nearest]]
    return distance, normals


def _content(path: Path, most_bytes: int) -> bytes:
    with naming(path, LayoutError):
        return read_named(path, most_bytes)


def _check_count(count: int) -> None:
    if count > MOST_TRIANGLES:
        raise ValueError(f"has more than {MOST_TRIANGLES} triangles; export a coarser mesh")


def _part(element: ElementTree.Element, urdf: Path, link: str) -> Floats:
    origin, shape = element.find("origin"), element.find("geometry/*")
    if shape is None:
        raise ValueError(f"{urdf}: link {link!r} has a geometry without a shape")
    xyz, rpy = ([0.0] * 3, [0.0] * 3)
    if origin is not None:
        xyz, rpy = _numbers(origin.get("xyz", "0 0 0")), _numbers(origin.get("rpy", "0 0 0"))
    return Pose.of_rpy(xyz, rpy).apply(_shape(shape, urdf, link))


def _shape(shape: ElementTree.Element, urdf: Path, link: str) -> Floats:
    if shape.tag == "mesh":
        scale = _numbers(shape.get("scale", "1 1 1"))
        triangles = read_triangles(_mesh_path(shape.get("filename", ""), urdf))
        return np.asarray(triangles * scale)
    if shape.tag == "box":
        return np.asarray(_prism(math.sqrt(0.5), 0.5, sides=4) * _numbers(shape.get("size", "")))
    (radius,) = _numbers(shape.get("radius", ""), 1)
    if shape.tag == "sphere":
        angle = np.linspace(-np.pi / 2, np.pi / 2, _SIDES // 2 + 1)
        return _turned(radius * np.cos(angle), radius * np.sin(angle))
    if shape.tag == "cylinder":
        half = _numbers(shape.get("length", ""), 1)[0] / 2
        return _prism(radius, half)
    raise ValueError(
        f"{urdf}: link {link!r} has a {shape.tag}, not a mesh, box, sphere or cylinder"
    )


def _mesh_path(name: str, urdf: Path) -> Path:
    """Find a mesh's file: beside the URDF, in a folder above, or in an installed package."""
    plain = re.sub(r"^(package|file)://", "", name)
    tails = [plain] if not name.startswith("package://") else [plain, plain.partition("/")[2]]
    for folder in (urdf.parent, *urdf.resolve().parents):
        for tail in tails:
            with suppress(OSError):  # a name may be too long for a file's
                if (path := folder / tail).is_file():
                    return path
    with suppress(OSError, ValueError):
        if (path := expanded(name)).is_file():
            return path
    raise ValueError(
        f"{urdf}: its mesh {name!r} is not found beside it, in a folder above, or in a package"
    )


def _prism(radius: float, half: float, sides: int = _SIDES) -> Floats:
    """Return a prism about z, radius up to its edges; four sides are parallel to x and y."""
    return _turned(radius * np.array([0.0, 1, 1, 0]), half * np.array([-1.0, -1, 1, 1]), sides)


def _turned(radius: Floats, height: Floats, sides: int = _SIDES) -> Floats:
    angle = np.pi / 4 + np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    flat = radius[:, None, None] * ring
    place = np.dstack([flat, np.broadcast_to(height[:, None], flat.shape[:2])])
    low, low_next, top, top_next = place[:-1, :-1], place[:-1, 1:], place[1:, :-1], place[1:, 1:]
    halves = np.stack([low, low_next, top_next], axis=2), np.stack([low, top_next, top], axis=2)
    return np.concatenate(halves).reshape(-1, 3, 3)


def _stl(data: bytes) -> Floats:
    count = int.from_bytes(data[80:84], "little") if len(data) >= _STL_HEADER else 0
    if len(data) == _STL_HEADER + _STL_FACET * count:
        _check_count(count)
        facets = np.frombuffer(data, np.uint8, offset=_STL_HEADER).reshape(count, _STL_FACET)
        corners = np.ascontiguousarray(facets[:, 12:48]).view("<f4")
        return corners.reshape(-1, 3, 3).astype(np.float64)
    _check_count(data.count(b"vertex") // 3)
    words = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
    if len(words) % 3:
        raise ValueError("an STL file that ends within a triangle")
    return np.array(words, dtype=np.float64).reshape(-1, 3, 3)


def _obj(data: bytes) -> Floats:
    corners, faces = array("d"), array("q")
    for line in io.BytesIO(data):
        if len(line) > _MOST_LINE:
            raise ValueError(f"a line of {len(line)} bytes; the limit is {_MOST_LINE}")
        kind, *words = line.split() or [b""]
        if kind == b"v":
            if len(words) < 3:
                raise ValueError("a corner of less than three numbers")
            corners.extend(map(float, words[:3]))
        elif kind == b"f":
            # From 1, or from the end: v, v/vt, v//vn.
            number = [int(word.partition(b"/")[0]) for word in words]
            place = [n - 1 if n > 0 else len(corners) // 3 + n for n in number]
            if not all(0 <= n < len(data) for n in place):
                raise ValueError(_NO_CORNER)
            for pair in pairwise(place[1:]):
                faces.extend((place[0], *pair))
        _check_count(max(len(faces) // 3, len(corners) // 9))
    which = np.frombuffer(faces, dtype=np.int64).reshape(-1, 3)
    if which.size and which.max() * 3 >= len(corners):
        raise ValueError(_NO_CORNER)
    return np.frombuffer(corners).reshape(-1, 3)[which]


_MAKERS = {".obj": _obj, ".stl": _stl}


def _numbers(text: str, count: int = 3) -> list[float]:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise ValueError(f"{text[:40]!r} where {count} numbers should be")
    return numbers
