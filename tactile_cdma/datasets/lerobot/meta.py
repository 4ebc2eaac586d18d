# SPDX-License-Identifier: Apache-2.0

"""What the metadata of an exported dataset say of its columns."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Floats32
from ...base.errors import CaptureError
from ...base.named_file import read_text
from ..samples import DERIVED, Kind, PatchInfo, SampleStream, skin_stream
from ..touch import MODES, POLICIES, slots
from . import ABOUT, INFO
from .features import Feature, features_of

STATE = "observation.state"
MOST_BYTES = 1 << 26
"""Largest file of metadata; chosen: 65,535 taxels take some 10 MB."""


@dataclass(frozen=True, slots=True)
class DatasetMeta:
    """An exported dataset, as far as its rows are made of skins and a state.

    patches, slots: the skins, and how many samples of each a tick has, by name. streams: by column.
    others: the observations that something else makes, such as images. about: what is known of the
    patches in the first file, by name.
    """

    path: Path
    fps: int
    mode: str
    policy: str
    patches: dict[str, PatchInfo]
    streams: dict[str, SampleStream]
    slots: dict[str, int]
    features: list[Feature]
    others: list[str]
    about: dict[str, dict[str, Any]]

    @classmethod
    def of(
        cls, patches: Iterable[PatchInfo], contacts: bool, fps: int, mode: str, policy: str
    ) -> DatasetMeta:
        """Describe a dataset of these skins and nothing else; contacts: which find contacts."""
        by_name = {patch.name: patch for patch in patches}
        counts = {name: slots(patch, fps, mode) for name, patch in by_name.items()}
        streams = {
            column: stream
            for column, stream in _columns(by_name.values()).items()
            if contacts or stream.patch
        }
        features = features_of(streams.values(), counts, mode)
        path = Path("skins")
        return cls(path, fps, mode, policy, by_name, streams, counts, features, [], {})

    @classmethod
    def read(cls, folder: Path) -> DatasetMeta:
        """Raises CaptureError for a folder that `tactile-cdma export --lerobot` did not write."""
        info, tactile = (_content(folder / name) for name in (INFO, ABOUT))
        try:
            patches = {name: _patch(name, taxels) for name, taxels in tactile["taxels"].items()}
            counts = {name: int(taxels["samples"]) for name, taxels in tactile["taxels"].items()}
            columns = _columns(patches.values())
            if STATE in info["features"]:
                names = tuple(info["features"][STATE]["names"])
                columns[STATE] = SampleStream(STATE, Kind.STATE, "state", (len(names),), names)
            found = {name: columns[name] for name in info["features"] if name in columns}
            mode, policy, fps = tactile["samples"], tactile["nan"], int(info["fps"])
            if mode not in MODES or policy not in POLICIES:
                raise ValueError(f"samples {mode!r}, nan {policy!r}")
            features = features_of(found.values(), counts, mode)
            for feature in features:
                if info["features"].get(feature.name) != feature.content():
                    raise ValueError(f"another {feature.name}")
            about = {patch["patch"]: patch for patch in reversed(tactile["patches"])}
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise CaptureError(f"{folder}: no dataset of this version's export: {error}") from None
        made = {feature.name for feature in features}
        others = [name for name in info["features"] if name.startswith("observation.")]
        others = [name for name in others if name not in made]
        return cls(folder, fps, mode, policy, patches, found, counts, features, others, about)


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
    """Return all streams that skins may have, by their columns."""
    return {
        (column := f"observation.{kind}.{patch.name}"): skin_stream(column, kind, patch)
        for patch in patches
        for kind in (Kind.TACTILE, *DERIVED)
    }


def _patch(name: str, taxels: dict[str, Any]) -> PatchInfo:
    count = len(taxels["node"])

    def known(key: str, *shape: int) -> Floats32:
        """Return an array of this shape; NaN where it is not known."""
        values = np.nan if taxels[key] is None else np.array(taxels[key]).reshape(shape)
        return np.full(shape, values, dtype=np.float32)

    return PatchInfo(
        name=name,
        topic="",
        rows=int(taxels["rows"]),
        columns=int(taxels["columns"]),
        nodes=np.array(taxels["node"], dtype=np.uint16),
        positions_m=known("position_m", count, 3),
        normals=known("normal", count, 3),
        areas_m2=known("area_m2", count),
        frame_period_s=float("nan"),
        about={},
    )
