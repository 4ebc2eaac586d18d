# SPDX-License-Identifier: Apache-2.0

"""A body's messages, in its frame, of those of its patches: taxels, contacts, and their names."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from struct import Struct

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Quaternion, Vector3
from geometry_msgs.msg import Pose as PoseMessage
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from tactile_cdma.msg import TactileSkinInfo

from ...base.arrays import Floats, Floats32
from ...config.body_file import short_name
from ...messages.cdr import CdrWriter, Heading, TaxelArray
from ...places.poses import Pose
from ...readings.status import Status
from ...readings.taxels import Coverage
from ..common.convert import places_of
from ..common.touches import ID, STATE, Touches

_SEQUENCE = Struct("<Q")
_NOWHERE = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
_MOST_TAXELS = 2**32 - 1
"""The largest number that the message holds."""
_TURNED = "position", "normal", "force", "velocity"
_NUMBERS = np.arange(STATE.itemsize // 8, dtype=np.float64).view(STATE)[0]
_VECTORS = np.stack([_NUMBERS[field] for field in _TURNED]).astype(np.intp)
"""(4, 3) index of each coordinate of these in a STATE as float64; the position comes first."""
LETTER_SHARE = 0.035
"""Height of letters in the diagonal of the box round all patches. Chosen: legible where the body
fills the picture."""
ABOVE_LETTERS = 2.2
"""Height of a text's middle above the top of its patch, in letters; chosen."""
LIFETIME = Duration(sec=1)
"""Names vanish that are not renewed for this long; chosen as for the skins below them."""
_RGBA = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)


class Places:
    """Where the taxels of a patch are, by its info; where they are in the body, by the last pose.

    positions_m: (t, 3) float64, m, in the patch's frame. areas_m2: (t,) float32, m².
    Raises MessageError, see places_of.
    """

    def __init__(self, info: TactileSkinInfo) -> None:
        self.info_id = info.info_id
        self.positions_m, self._normals, self.areas_m2 = places_of(info)
        self._placed: tuple[Pose, Floats32, Floats32] | None = None

    def __len__(self) -> int:
        return len(self.areas_m2)

    def placed(self, pose: Pose | None) -> tuple[Floats32, Floats32]:
        """Return positions and normals in the body's frame; NaN without a pose."""
        pose = pose or _NOWHERE
        if self._placed is None or self._placed[0] is not pose:
            positions_m = pose.apply(self.positions_m).astype(np.float32)
            normals = pose.rotate(self._normals).astype(np.float32)
            self._placed = pose, positions_m, normals
        return self._placed[1:]


@dataclass(frozen=True, slots=True)
class Part:
    """A patch that was heard. pose: in the body's frame; None: unknown. absent: no present data."""

    name: str
    array: TaxelArray
    places: Places
    pose: Pose | None
    absent: bool


def body_tactile(
    parts: Sequence[Part], absent: Sequence[str], heading: Heading, sequence: int
) -> bytes:
    """Return the message TactileBody. absent: all patches that are, heard ever or not."""
    sizes = [len(part.places) for part in parts]
    readings = [
        (np.full(size, np.nan), np.full(size, Status.STALE))
        if part.absent
        else (part.array.pressure_pa, part.array.status)
        for part, size in zip(parts, sizes, strict=True)
    ]
    placed = [part.places.placed(part.pose) for part in parts]
    writer = CdrWriter()
    writer.header(heading)
    writer.add(_SEQUENCE.pack(sequence), 8)
    writer.texts(absent)
    writer.texts([part.name for part in parts])
    writer.array(np.cumsum([0, *sizes])[:-1].astype("<u4"))
    writer.count(len(parts))
    for part in parts:
        writer.add(part.array.heading.stamp, 4)
    none, nowhere = np.zeros(0, "u1"), np.zeros((0, 3), "<f4")
    writer.array(np.concatenate([none, *(pressures for pressures, _ in readings)]).astype("<f4"))
    writer.array(np.concatenate([none, *(status for _, status in readings)]).astype("u1"))
    for vectors in zip(*placed, strict=True) if placed else ((), ()):
        writer.array(np.concatenate([nowhere, *vectors]).astype("<f4"))
    writer.array(np.concatenate([none, *(part.places.areas_m2 for part in parts)]).astype("<f4"))
    return writer.message


def body_contacts(
    parts: Sequence[tuple[Pose, Touches]], absent: list[str], heading: Heading, sequence: int
) -> Touches:
    """Return the contacts of a body, strongest first.

    parts: each patch's pose in the body's frame, and its latest message. absent: the other patches.
    The centre of pressure weighs contacts by their forces. Sums are NaN by the rules of
    TactileContacts.msg, and where those of a touched patch are.
    """
    touched = [(pose, message) for pose, message in parts if message.patches]
    rotations = np.array([pose.rotation for pose, _ in touched]).reshape(-1, 3, 3)
    places_m = np.array([pose.translation_m for pose, _ in touched]).reshape(-1, 3)
    states = _joined([message.states for _, message in touched], STATE)
    of = [i for i, (_, message) in enumerate(touched) for _ in message.patches]
    numbers = states.view(np.float64).reshape(-1, STATE.itemsize // 8)
    vectors = numbers[:, _VECTORS] @ rotations[of].transpose(0, 2, 1)
    vectors[:, 0] += places_m[of]
    numbers[:, _VECTORS] = vectors
    forces_n = np.sqrt(np.square(states["force"]).sum(axis=1))
    coverage = Coverage(
        min(sum(message.taxels_valid for _, message in parts), _MOST_TAXELS),
        min(sum(message.taxels_in_service for _, message in parts), _MOST_TAXELS),
    )
    untouched = coverage.is_whole and not absent and all(m.untouched for _, m in parts)
    sums = np.full(7, 0.0 if untouched else np.nan)
    if touched and coverage.is_most and len(parts) >= len(absent):
        sums = _sums([message for _, message in touched], rotations, places_m)
    centre_m = np.full(3, np.nan)
    if forces_n.any() and np.isfinite(sums).all():
        centre_m = forces_n @ states["position"] / forces_n.sum()
    with np.errstate(over="ignore"):
        area_m2 = float(np.float32(sums[0]))
    order = np.argsort(-forces_n, kind="stable")
    patches = [patch for _, message in touched for patch in message.patches]
    taxels = [some for _, message in touched for some in message.taxels]
    return Touches(
        heading=heading,
        sequence=sequence,
        info_id=0,
        stamp_uncertainty_s=max((m.stamp_uncertainty_s for _, m in parts), default=math.inf),
        absent=absent,
        taxels_in_service=coverage.in_service,
        taxels_valid=coverage.valid,
        touched=bool(patches),
        untouched=untouched,
        area_m2=area_m2,
        position_m=centre_m,
        force_n=sums[1:4],
        torque_nm=sums[4:],
        patches=[patches[i] for i in order],
        ids=_joined([message.ids for _, message in touched], ID)[order],
        states=states[order],
        taxels=[taxels[i] for i in order],
    )


def _joined(arrays: list[NDArray[np.void]], kind: np.dtype[np.void]) -> NDArray[np.void]:
    # np.concatenate compares the fields of all arrays, which takes longer.
    return np.frombuffer(bytearray().join(array.tobytes() for array in arrays), kind)


def _sums(messages: Sequence[Touches], rotations: Floats, places_m: Floats) -> Floats:
    """Add up (7,) area (m²), force (N), torque (N m) of p patches about the body's origin.

    rotations: (p, 3, 3). places_m: (p, 3). Both: of their poses.
    """
    wrenches = np.array([(m.force_n, m.torque_nm) for m in messages])
    forces_n, torques_nm = (wrenches @ rotations.transpose(0, 2, 1)).transpose(1, 0, 2)
    a, b = places_m, forces_n  # np.cross takes five times as long
    crossed = a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
    torque_nm = torques_nm.sum(axis=0) + crossed.sum(axis=0)
    area_m2 = sum(message.area_m2 for message in messages)
    return np.array([area_m2, *forces_n.sum(axis=0), *torque_nm])


def body_names(places_m: Mapping[str, Floats], frame_id: str) -> MarkerArray:
    """Return a marker per patch, in a namespace of the patch's name; up is the z of the frame.

    places_m: (t, 3) taxels of each patch in the frame, m, by the fully qualified name of its
    driver; t > 0. The stamp is 0, which to rviz is now: names do not wait for transforms.
    """
    corners_m = {node: (at.min(axis=0), at.max(axis=0)) for node, at in places_m.items()}
    lows_m, highs_m = zip(*corners_m.values(), strict=True)
    letter_m = LETTER_SHARE * float(np.linalg.norm(np.max(highs_m, 0) - np.min(lows_m, 0)))
    markers = []
    for node, (low_m, high_m) in corners_m.items():
        x, y, _ = ((low_m + high_m) / 2).tolist()
        name = short_name(node)
        markers.append(
            Marker(
                header=Header(frame_id=frame_id),
                ns=name,
                type=Marker.TEXT_VIEW_FACING,
                pose=PoseMessage(
                    position=Point(x=x, y=y, z=float(high_m[2]) + ABOVE_LETTERS * letter_m),
                    orientation=Quaternion(w=1.0),
                ),
                scale=Vector3(z=letter_m),
                color=_RGBA,
                lifetime=LIFETIME,
                text=name,
            )
        )
    return MarkerArray(markers=markers)
