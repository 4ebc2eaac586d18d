# SPDX-License-Identifier: Apache-2.0

"""What the metadata of an exported dataset say of its columns."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...base.arrays import Floats32
from ...base.errors import CaptureError
from ...base.named_file import read_text
from ...config.python_arguments import argument
from ..alignment import MODES, MOST_SLOTS, POLICIES, slots, stale_s
from ..samples import DERIVED, Kind, PatchInfo, SampleStream, patches_of, skin_stream
from ..tables import constants
from . import ABOUT, INFO
from .features import Feature, features_of

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
