# SPDX-License-Identifier: Apache-2.0

"""TactileContacts as arrays, and these as bytes: what drivers publish and a body's node reads."""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Floats
from ...base.errors import MessageError
from ...messages.cdr import CdrReader, CdrWriter, Heading

ID = np.dtype([("id", "<u4"), ("age", "<f4")])
"""The numbers of a TactileContact before those of STATE: id, and age in s."""
_VECTOR = ("<f8", 3)
STATE = np.dtype(
    [
        ("position", *_VECTOR),
        ("normal", *_VECTOR),
        ("force", *_VECTOR),
        ("area", "<f4"),
        ("pressure_max", "<f4"),
        ("saturated", "?"),
        ("lower_bound", "?"),
        ("padding", "V6"),
        ("velocity", *_VECTOR),
        ("force_rate", "<f4"),
        ("taxels", "<u4"),
    ]
)
"""The other numbers of a TactileContact as they lie in the message from a multiple of 8 on, in the
units of TactileContact.msg; taxels: how many."""


def packer(kind: np.dtype[np.void]) -> Struct:
    """Packs an element of a kind, such as STATE, from its numbers, without making an array."""
    assert kind.fields is not None
    parts = [(part.base, (*part.shape, 1)[0]) for part, *_ in kind.fields.values()]
    chars = [(f"{one.itemsize}x" if one.kind == "V" else one.char) * n for one, n in parts]
    return Struct("<" + "".join(chars))


_ID, _STATE = np.dtype((np.void, ID.itemsize)), np.dtype((np.void, STATE.itemsize))
_SEQUENCE, _COVERAGE, _AREA, _SUMS = Struct("<QIf"), Struct("<II2?"), Struct("<f"), Struct("<9d")


@dataclass(frozen=True, eq=False, slots=True)
class Touches:
    """A message TactileContacts.

    area_m2, position_m, force_n, torque_nm: of all c contacts together. patches: name of each
    contact's patch. ids: (c,) ID. states: (c,) STATE. taxels: of each contact, as uint16.
    """

    heading: Heading
    sequence: int
    info_id: int
    stamp_uncertainty_s: float
    absent: list[str]
    taxels_in_service: int
    taxels_valid: int
    touched: bool
    untouched: bool
    area_m2: float
    position_m: Floats
    force_n: Floats
    torque_nm: Floats
    patches: list[str]
    ids: NDArray[np.void]
    states: NDArray[np.void]
    taxels: list[bytes]

    @property
    def message(self) -> bytes:
        writer = CdrWriter()
        writer.header(self.heading)
        writer.add(_SEQUENCE.pack(self.sequence, self.info_id, self.stamp_uncertainty_s), 8)
        writer.texts(self.absent)
        counts = self.taxels_in_service, self.taxels_valid
        writer.add(_COVERAGE.pack(*counts, self.touched, self.untouched), 4)
        writer.add(_AREA.pack(self.area_m2), 4)
        sums = np.concatenate([self.position_m, self.force_n, self.torque_nm])
        writer.add(sums.astype("<f8").tobytes(), 8)
        writer.count(len(self.patches))
        ids, states = self.ids.view(_ID).tolist(), self.states.view(_STATE).tolist()
        for patch, number, state, taxels in zip(
            self.patches, ids, states, self.taxels, strict=True
        ):
            writer.text(patch)
            writer.add(number, 4)
            writer.add(state + taxels, 8)
        return writer.message

    @classmethod
    def read(cls, message: bytes) -> Touches:
        """Take a message apart; raises MessageError if it is none, or contradicts itself."""
        reader = CdrReader(message)
        heading = reader.header()
        sequence, info_id, uncertainty_s = reader.numbers(_SEQUENCE, 8)
        absent = [reader.text() for _ in range(reader.count())]
        in_service, valid, touched, untouched = reader.numbers(_COVERAGE, 4)
        [area_m2] = reader.numbers(_AREA, 4)
        sums = np.frombuffer(reader.take(_SUMS.size, 8), dtype="<f8").reshape(3, 3)
        patches, ids, states, taxels = [], [], [], []
        for _ in range(reader.count()):
            patches.append(reader.text())
            ids.append(reader.take(ID.itemsize, 4))
            states.append(reader.take(STATE.itemsize, 8))
            taxels.append(reader.take(2 * int.from_bytes(states[-1][-4:], "little")))
        is_whole = valid == in_service
        if touched != bool(patches) or valid > in_service or untouched > (is_whole and not touched):
            raise MessageError(
                f"frame {sequence} has {len(patches)} contacts and {valid} of {in_service} taxels "
                f"valid, and claims touched={touched}, untouched={untouched}"
            )
        arrays = np.frombuffer(b"".join(ids), ID), np.frombuffer(b"".join(states), STATE)
        return cls(
            *(heading, sequence, info_id, uncertainty_s, absent),
            *(in_service, valid, touched, untouched, area_m2, sums[0], sums[1], sums[2]),
            *(patches, *arrays, taxels),
        )
