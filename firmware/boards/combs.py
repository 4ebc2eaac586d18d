# SPDX-License-Identifier: Apache-2.0

"""Footprints of the sensors' electrodes: two combs on the front, one with a ring round the other.

    python firmware/boards/combs.py            writes them into firmware/boards/kicad/tactile.pretty
    python firmware/boards/combs.py --check    lists stale ones, exit code 1 if any

Ground is the comb with the ring, so that neighbours do not see each other through the sheet that
lies on both. A hole in each comb leads to the board's other side.
"""

from __future__ import annotations

import sys
import uuid
from dataclasses import dataclass
from pathlib import Path

LIBRARY = Path(__file__).resolve().parent / "kicad" / "tactile.pretty"
SPINE_MM, HOLE_MM = 0.6, 0.3
"""Width of the inner comb's back, which holds its hole, and diameter of a hole. Chosen: what every
board house drills."""
Rectangle = tuple[float, float, float, float]
"""Left, top, right, bottom, mm from the middle."""


@dataclass(frozen=True, slots=True)
class Comb:
    """Is a sensor of size × size mm, with fingers of a width, so far apart at least, mm."""

    size: float
    width: float
    gap: float

    @property
    def name(self) -> str:
        return f"Comb_{self.size:g}x{self.size:g}mm"

    @property
    def edge(self) -> float:
        """Return the distance from the middle to the inner comb."""
        return self.size / 2 - self.width - self.gap

    @property
    def fingers(self) -> int:
        """Count the fingers of the inner comb, between which the outer one has one less."""
        return int((2 * self.edge + self.width + 2 * self.gap) / (2 * (self.width + self.gap)))

    @property
    def pitch(self) -> float:
        """Return the distance from a finger to the next one, of the other comb."""
        return (2 * self.edge - self.width) / (2 * self.fingers - 2)

    def inner(self) -> list[Rectangle]:
        """Draw the sensor's comb: its back at the right, then its fingers."""
        edge = self.edge
        tops = [-edge + 2 * i * self.pitch for i in range(self.fingers)]
        back = (edge - SPINE_MM, -edge, edge, edge)
        return [back, *((-edge, top, edge - SPINE_MM, top + self.width) for top in tops)]

    def outer(self) -> list[Rectangle]:
        """Draw ground: the ring's four sides, then its fingers, from the left."""
        half, w = self.size / 2, self.width
        ring = [(-half, -half, half, w - half), (-half, half - w, half, half)]
        ring += [(-half, w - half, w - half, half - w), (half - w, w - half, half, half - w)]
        end = self.edge - SPINE_MM - (self.pitch - w)
        tops = [-self.edge + (2 * i + 1) * self.pitch for i in range(self.fingers - 1)]
        return [*ring, *((w - half, top, end, top + w) for top in tops)]

    def text(self) -> str:
        """Write the footprint as KiCad's file."""
        half = self.size / 2
        lines = [
            f'(footprint "{self.name}" (version 20241229) (generator "tactile_cdma") '
            '(layer "F.Cu")',
            f' (descr "electrodes: fingers of {self.width:g} mm, {self.pitch - self.width:.3g} mm '
            'apart") (attr smd exclude_from_pos_files)',
            self._text("Reference", "J**", "F.Fab"),
            self._text("Value", self.name, "F.Fab"),
            f" (fp_rect (start {-half:g} {-half:g}) (end {half:g} {half:g}) (stroke (width 0.05) "
            f'(type default)) (fill no) (layer "F.CrtYd") {self._id("courtyard")})',
        ]
        for number, parts in (("1", self.inner()), ("2", self.outer())):
            lines += [self._pad(number, i, part) for i, part in enumerate(parts)]
        corner = half - SPINE_MM / 2
        for number, x, y in (("1", self.edge - SPINE_MM / 2, 0.0), ("2", -corner, corner)):
            lines.append(
                f' (pad "{number}" thru_hole circle (at {x:g} {y:g}) '
                f"(size {SPINE_MM:g} {SPINE_MM:g}) (drill {HOLE_MM:g}) "
                f'(layers "*.Cu") {self._id(f"hole {number} {x} {y}")})'
            )
        return "\n".join([*lines, ")", ""])

    def _pad(self, number: str, index: int, part: Rectangle) -> str:
        left, top, right, bottom = part
        at = f"(at {(left + right) / 2:.6g} {(top + bottom) / 2:.6g})"
        size = f"(size {right - left:.6g} {bottom - top:.6g})"
        layers = '(layers "F.Cu" "F.Mask")'
        return f' (pad "{number}" smd rect {at} {size} {layers} {self._id(f"{number} {index}")})'

    def _text(self, kind: str, text: str, layer: str) -> str:
        effects = "(effects (font (size 0.5 0.5) (thickness 0.08)))"
        hidden = f'(at 0 0 0) (layer "{layer}") (hide yes) {self._id(kind)} {effects}'
        return f' (property "{kind}" "{text}" {hidden})'

    def _id(self, what: str) -> str:
        return f'(uuid "{uuid.uuid5(uuid.NAMESPACE_OID, f"{self.name} {what}")}")'


COMBS = (Comb(8.0, 0.4, 0.35), Comb(5.5, 0.3, 0.35))
"""Combs of the strips, and of the paper's units (Liu et al. 2025, Fig. 5)."""


def main() -> int:
    """Write the footprints that have changed, or list them."""
    check = sys.argv[1:] == ["--check"]
    stale = []
    for comb in COMBS:
        file = LIBRARY / f"{comb.name}.kicad_mod"
        if not file.exists() or file.read_bytes() != comb.text().encode():
            stale.append(file.name)
            if not check:
                file.write_text(comb.text(), encoding="utf-8")
    for name in stale:
        print(f"{name}: {'stale; run firmware/boards/combs.py' if check else 'written'}")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
