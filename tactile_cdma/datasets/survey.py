# SPDX-License-Identifier: Apache-2.0

"""What the frames of a patch are like, for people: rate, gaps, share of invalid readings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..readings.stages import Status
from .samples import Completeness, SkinFrame, shown_taxels


class FrameSurvey:
    """Takes all frames of a patch in order; memory does not grow."""

    def __init__(self) -> None:
        self._frames = self._missing = self._gaps = 0
        self._first_s = self._last_s = float("nan")
        self._longest_s, self._longest_at_s = 0.0, 0.0
        self._sequence: int | None = None
        self._readings = self._invalid = self._held = self._saturated = 0
        self._completeness = Completeness()
        self._complete_s: float | None = None

    def take(self, frame: SkinFrame) -> None:
        """Take in the next frame."""
        time_s = frame.device_time_s if np.isnan(frame.wall_time_s) else frame.wall_time_s
        if not self._frames:
            self._first_s = self._last_s = time_s
        step_s, missing = time_s - self._last_s, 0
        if self._sequence is not None and frame.sequence > self._sequence:
            missing = frame.sequence - self._sequence - 1
        if missing:
            self._gaps += 1
            self._missing += missing
            if step_s > self._longest_s:
                self._longest_s, self._longest_at_s = step_s, self._last_s - self._first_s
        self._frames += 1
        self._last_s, self._sequence = time_s, frame.sequence
        in_service = frame.in_service
        invalid = in_service & ~np.isfinite(frame.pressure_pa)
        self._readings += int(np.count_nonzero(in_service))
        self._invalid += int(np.count_nonzero(invalid))
        for bit, name in ((Status.SILENT, "_held"), (Status.SATURATED, "_saturated")):
            some = in_service & ~invalid & (frame.status & np.uint8(bit) != 0)
            setattr(self, name, getattr(self, name) + int(np.count_nonzero(some)))
        if self._complete_s is None:
            self._completeness.take(frame)
            if self._completeness.is_complete:
                self._complete_s = time_s - self._first_s

    def lines(self) -> Iterator[tuple[str, str]]:
        """Names and texts."""
        length_s = self._last_s - self._first_s
        rate = f", {(self._frames - 1) / length_s:.2f} Hz" if length_s > 0 else ""
        yield "frames", f"{self._frames} in {length_s:.3f} s{rate}"
        gaps = "none"
        if self._gaps:
            gaps = (
                f"{self._gaps}, {self._missing} frame periods without a frame, the longest "
                f"{self._longest_s:.3f} s after {self._longest_at_s:.3f} s"
            )
        yield "gaps", gaps
        yield (
            "readings",
            f"{_share(self._invalid, self._readings)} invalid (NaN), "
            f"{_share(self._held, self._readings)} held, "
            f"{_share(self._saturated, self._readings)} saturated",
        )
        yield "complete", self._complete()

    def _complete(self) -> str:
        if self._complete_s is None:
            return f"never: no valid reading of {shown_taxels(self._completeness.missing)}"
        if not self._complete_s:
            return "from the first frame on"
        return (
            f"after {self._complete_s:.3f} s: until then a node that had not spoken was unknown; "
            "export --from-first-complete leaves that out"
        )


def _share(some: int, of: int) -> str:
    return f"{some / of:.2%}" if of else "none"
