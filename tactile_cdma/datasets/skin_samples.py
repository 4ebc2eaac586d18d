# SPDX-License-Identifier: Apache-2.0

"""A skin's frames as samples: the same of a recording and of a running skin."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from .. import __version__
from ..base.arrays import Floats32
from ..config.skin_config import SkinConfig
from ..driver.digitizer import Source
from ..readings.contact import Contacts
from .samples import PatchInfo, Sample, SkinFrame


def patch_info(
    config: SkinConfig, source: Source, name: str, about: Mapping[str, Any]
) -> PatchInfo:
    """A patch that is decoded here. source: who measures. about: what else is known of it."""
    layout = config.layout
    return PatchInfo(
        name=name,
        topic="",
        rows=layout.rows,
        columns=layout.columns,
        nodes=layout.nodes.astype(np.uint16),
        positions_m=layout.positions_m.astype(np.float32),
        normals=layout.normals.astype(np.float32),
        areas_m2=layout.areas_m2.astype(np.float32),
        frame_period_s=config.spec.frame_period_s,
        about={
            "origin": source.origin.name.lower(),
            "measured_by": source.measured_by.name.lower(),
            "skin": config.skin,
            "digitizer_id": (source.digitizer_id or b"").hex().upper(),
            "calibration_id": config.calibration.identity,
            "package_version": __version__,
            **about,
        },
    )


def samples_of(
    keys: Sequence[str], frame: SkinFrame, found: Contacts | None, stamp_ns: int, seen_ns: int
) -> Iterator[Sample]:
    """Samples of a frame and, unless None, of its contacts.

    keys: of the streams of touch, contacts and wrench.
    """
    tactile, contacts, wrench = keys
    yield Sample(tactile, stamp_ns, seen_ns, frame)
    if found is not None:
        yield Sample(contacts, stamp_ns, seen_ns, _contacts(found))
        yield Sample(wrench, stamp_ns, seen_ns, found.wrench.astype(np.float32))


def _contacts(found: Contacts) -> Floats32:
    """(7,) by samples.CONTACT_NAMES."""
    counts = float(found.touched), float(found.untouched), float(len(found))
    return np.array([*counts, found.total_area_m2, *found.centre_m], dtype=np.float32)
