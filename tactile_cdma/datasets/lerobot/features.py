# SPDX-License-Identifier: Apache-2.0

"""Which columns a dataset has, and what a row puts into them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..alignment import DROP, KEEP, WINDOW, Row, Touch
from ..parquet_table import PNG_OR_JPEG
from ..samples import DERIVED, NANO, Kind, RawImage, SampleStream
from ..sources.images import check_size, depth, encoded

TIME = "unix_time_ns"
"""Feature: the tick as Unix time; an integer, as torch makes float32 of the others. Not called
observation: policies take no notice of it."""


@dataclass(frozen=True, slots=True)
class Feature:
    """A column of the dataset.

    dtype: numpy's name, or PNG_OR_JPEG. names: of axes or elements. pooled: one statistic for all
    elements. mask: 1 for a valid element of the column before, 0 for others; float32, since LeRobot
    normalises all that is called observation, and cannot do that with bool.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    unit: str = ""
    pooled: bool = False
    mask: bool = False

    def content(self) -> dict[str, Any]:
        names = list(self.names) if self.names else None
        return {"dtype": self.dtype, "shape": list(self.shape), "names": names}


def features_of(
    streams: Iterable[SampleStream], slots: Mapping[str, int], mode: str
) -> list[Feature]:
    """Return the columns for some streams. slots: samples of a tick, by the patches' features."""
    features = [Feature(TIME, "int64", (1,), (TIME,), "ns")]
    vectors: dict[str, tuple[str, ...]] = {}  # of several publishers
    for stream in streams:
        name, size = column(stream), stream.shape
        if stream.kind == Kind.TACTILE:
            taxels = tuple(f"taxel_{i}" for i in range(size[0]))
            ages = tuple(f"age_{i}" for i in range(slots[stream.feature]))
            if mode == WINDOW:
                size, taxels = (slots[stream.feature], *size), ("sample", "taxel")
            features += [
                Feature(name, "float32", size, taxels, "Pa", pooled=True),
                Feature(f"{name}.valid", "float32", size, taxels, mask=True),
                Feature(f"{name}.age_s", "float32", (len(ages),), ages, "s"),
            ]
        elif stream.kind in DERIVED:
            features.append(Feature(name, "float32", size, stream.names))
            features.append(Feature(f"{name}.valid", "float32", size, stream.names, mask=True))
        elif stream.kind in (Kind.STATE, Kind.ACTION):
            vectors[name] = (*vectors.get(name, ()), *stream.names)
        elif stream.kind == Kind.DEPTH:
            axes = ("height", "width")
            features.append(Feature(name, stream.dtype, size, axes, stream.unit, pooled=True))
        else:
            features.append(Feature(name, PNG_OR_JPEG, size, ("height", "width", "channels")))
    features += [Feature(name, "float32", (len(its),), its) for name, its in vectors.items()]
    return features


def column(stream: SampleStream) -> str:
    """Return the name of a stream's feature."""
    if stream.kind == Kind.ACTION:
        return "action"
    if stream.kind == Kind.STATE:
        return "observation.state"
    group = "images" if stream.kind == Kind.IMAGE else stream.kind
    return f"observation.{group}.{stream.feature}"


def obstacle(
    row: Row, streams: Iterable[SampleStream], policy: str, begin_ns: int, source: object
) -> str | None:
    """Say why a row has to be left out, in words; None if it is whole.

    begin_ns: Unix time of the beginning of the source, which is called so.
    Touch, contacts and wrench have masks, and may have stopped; an old command is still in force.
    An image or a state would be taken for the present one.
    """
    for stream in streams:
        value = row.values.get(stream.key)
        if value is None and stream.kind not in DERIVED:
            if (last_ns := row.stopped.get(stream.key)) is None:
                return f"{column(stream)} had not begun"
            since = f"first at {(last_ns - begin_ns) / NANO:.3f} s of {source}"
            return f"{column(stream)} ({stream.topic}) had stopped, {since}"
        if isinstance(value, Touch) and policy == DROP and not value.complete:
            return f"a taxel of {column(stream)} had no valid reading"
    return None


def cells(
    row: Row, streams: Iterable[SampleStream], features: Iterable[Feature], policy: str = ""
) -> dict[str, Any]:
    """Return what a row without an obstacle puts into the columns. policy: see alignment."""
    unknown = np.float32(np.nan if policy == KEEP else 0)
    found: dict[str, Any] = {TIME: np.array([row.tick.time_ns])}
    elements: dict[str, dict[str, Any]] = {}  # of vectors, by their names
    for stream in streams:
        name, value = column(stream), row.values.get(stream.key)
        if isinstance(value, Touch):
            found |= {
                name: value.pressure_pa,
                f"{name}.valid": value.valid,
                f"{name}.age_s": value.age_s,
            }
        elif stream.kind in DERIVED:
            values: Any = np.full(stream.shape, np.nan, np.float32) if value is None else value
            valid = np.isfinite(values)
            found |= {name: np.where(valid, values, unknown), f"{name}.valid": valid}
        elif isinstance(value, RawImage):
            check_size(value.message, stream.key, stream.shape)
            take = depth if stream.kind == Kind.DEPTH else encoded
            found[name] = take(value.message, stream.key)
        else:
            assert isinstance(value, np.ndarray)
            elements.setdefault(name, {}).update(zip(stream.names, value, strict=True))
    for feature in features:  # in the order of the dataset, whoever published first
        if its := elements.get(feature.name):
            found[feature.name] = np.array([its[name] for name in feature.names], np.float32)
    return found
