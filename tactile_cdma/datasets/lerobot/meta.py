# SPDX-License-Identifier: Apache-2.0

"""The columns of a dataset: what a row puts into them, and what the metadata say of them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...base.arrays import Floats32
from ...base.errors import CaptureError
from ...base.named_file import read_text
from ...config.python_arguments import argument
from ..alignment import DROP, KEEP, MODES, MOST_SLOTS, POLICIES, WINDOW, Row, Touch, slots, stale_s
from ..parquet_table import PNG_OR_JPEG
from ..samples import (
    DERIVED,
    NANO,
    Kind,
    PatchInfo,
    RawImage,
    SampleStream,
    patches_of,
    skin_stream,
)
from ..sources.images import check_size, depth, encoded
from ..tables import constants
from . import ABOUT, INFO

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


STATE = "observation.state"
MOST_BYTES = 1 << 24
"""Largest file of metadata; chosen: 65,535 taxels take some 10 MB."""
MOST_FPS = 1_000_000
"""Most rows per s; chosen: far above what a topic's stamps, by which rows may be, can have."""


@dataclass(frozen=True, slots=True)
class DatasetMeta:
    """An exported dataset, as far as its rows are made of skins and a state.

    patches, slots: the skins, and how many samples of each a tick has, by name. streams: by column.
    others: the observations that something else makes, such as images. about: what is known of the
    patches in the first file, by name. states: the streams of topics that the state is joined of.
    """

    path: Path
    fps: int
    mode: str
    policy: str
    patches: dict[str, PatchInfo]
    streams: dict[str, SampleStream]
    slots: dict[str, int]
    features: list[Feature]
    others: list[str] = field(default_factory=list)
    about: dict[str, dict[str, Any]] = field(default_factory=dict)
    states: dict[str, SampleStream] = field(default_factory=dict)

    @classmethod
    def of(
        cls, patches: Iterable[PatchInfo], contacts: bool, fps: int, mode: str, policy: str
    ) -> DatasetMeta:
        """Describe a dataset of these skins and nothing else; contacts: which find contacts."""
        columns = _columns(patches).items()
        streams = {name: stream for name, stream in columns if contacts or stream.patch}
        return cls.of_streams(streams, fps, mode, policy)

    @classmethod
    def of_streams(
        cls, streams: dict[str, SampleStream], fps: int, mode: str, policy: str
    ) -> DatasetMeta:
        """Describe a dataset of streams, skins among them, by whatever keys."""
        patches = {patch.name: patch for patch in patches_of(streams).values()}
        counts = {name: slots(patch, fps, mode) for name, patch in patches.items()}
        features = features_of(streams.values(), counts, mode)
        states = {key: one for key, one in streams.items() if one.kind == Kind.STATE}
        columns = patches, streams, counts, features
        return cls(Path("skins"), fps, mode, policy, *columns, states=states)

    @classmethod
    def read(cls, folder: Path) -> DatasetMeta:
        """Raises CaptureError for a folder that `tactile-cdma export --lerobot` did not write."""
        info, tactile = (_content(folder / name) for name in (INFO, ABOUT))
        try:
            patches = {name: _patch(name, taxels) for name, taxels in tactile["taxels"].items()}
            counts = {name: taxels["samples"] for name, taxels in tactile["taxels"].items()}
            columns = _columns(patches.values())
            if STATE in info["features"]:
                columns[STATE] = _state(STATE, info["features"][STATE]["names"])
            found = {name: columns[name] for name in info["features"] if name in columns}
            mode, policy = tactile["samples"], tactile["nan"]
            fps = argument("fps", info["fps"], 0, (1, MOST_FPS))
            if mode not in MODES or policy not in POLICIES or not patches:
                raise ValueError(f"samples {mode!r}, nan {policy!r}, patches {list(patches)}")
            for name, count in counts.items():
                argument(f"samples of {name}", count, 0, (1, MOST_SLOTS))
            features = features_of(found.values(), counts, mode)
            for feature in features:
                if info["features"].get(feature.name) != feature.content():
                    raise ValueError(f"another {feature.name}")
            about = {patch["patch"]: patch for patch in reversed(tactile["patches"])}
            if not all(isinstance(one.get("parameters"), dict | None) for one in about.values()):
                raise TypeError("its parameters are not valid")
            states = {key: _state(key, its) for key, its in tactile.get("states", {}).items()}
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise CaptureError(f"{folder}: not this version's dataset: {error}") from None
        made = {feature.name for feature in features}
        others = [name for name in info["features"] if name.startswith("observation.")]
        others = [name for name in others if name not in made]
        about_all = features, others, about, states
        return cls(folder, fps, mode, policy, patches, found, counts, *about_all)

    def content(self, clock: str, from_first_complete: bool) -> dict[str, Any]:
        """Return what ABOUT says, but for patches and files. clock: what the rows' times are."""
        taxels = {
            patch.name: {
                "rows": patch.rows,
                "columns": patch.columns,
                **constants(patch),
                "samples": self.slots[patch.name],
            }
            for patch in self.patches.values()
        }
        return {
            "package_version": __version__,
            "samples": self.mode,
            "nan": self.policy,
            "stale_s": stale_s(self.fps),
            "clock": clock,
            "from_first_complete": from_first_complete,
            "units": {one.name: one.unit for one in self.features if one.unit},
            "states": {key: one.names for key, one in self.states.items()},
            "taxels": taxels,
        }


def _content(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(read_text(path, MOST_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CaptureError(
            f"{path}: not read: {reason}; is its folder a dataset of tactile-cdma export --lerobot?"
        ) from None
    if not isinstance(found, dict):
        raise CaptureError(f"{path}: not an object")
    return found


def _columns(patches: Iterable[PatchInfo]) -> dict[str, SampleStream]:
    return {
        (column := f"observation.{kind}.{patch.name}"): skin_stream(column, kind, patch)
        for patch in patches
        for kind in (Kind.TACTILE, *DERIVED)
    }


def _state(key: str, names: Iterable[str]) -> SampleStream:
    names = tuple(names)
    ", ".join(names)  # raises where one is no text
    return SampleStream(key, Kind.STATE, "state", (len(names),), names)


def _patch(name: str, taxels: dict[str, Any]) -> PatchInfo:
    count = len(taxels["node"])
    rows, columns = np.arange(count).reshape(taxels["rows"], taxels["columns"]).shape

    def known(key: str, *shape: int) -> Floats32:
        """Return an array of this shape; NaN where it is not known."""
        values = np.nan if taxels[key] is None else np.array(taxels[key]).reshape(shape)
        return np.full(shape, values, dtype=np.float32)

    return PatchInfo(
        name=name,
        topic="",
        rows=rows,
        columns=columns,
        nodes=np.array(taxels["node"], dtype=np.uint16),
        positions_m=known("position_m", count, 3),
        normals=known("normal", count, 3),
        areas_m2=known("area_m2", count),
        frame_period_s=float("nan"),
        about={},
    )
