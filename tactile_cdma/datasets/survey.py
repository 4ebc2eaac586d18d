# SPDX-License-Identifier: Apache-2.0

"""What the frames of a patch are like, for people: rate, gaps, share of invalid readings."""

from collections.abc import Iterator

import numpy as np

from ..readings.status import Status, is_in_service
from .samples import Completeness, Continuity, SkinFrame


class FrameSurvey:
    """Takes all frames of a patch in order; memory does not grow."""

    def __init__(self) -> None:
        self._frames = 0
        self._continuity = Continuity()
        self._readings = np.zeros(4, dtype=np.int64)  # in service, invalid, held, saturated
        self._completeness = Completeness()
        self._complete_s: float | None = None

    def take(self, frame: SkinFrame) -> None:
        time_s = frame.device_time_s if np.isnan(frame.wall_time_s) else frame.wall_time_s
        self._continuity.take(frame.sequence, time_s)
        self._frames += 1
        in_service = is_in_service(frame.status)
        valid = in_service & frame.valid
        bits = np.uint8(Status.SILENT), np.uint8(Status.SATURATED)
        kinds = in_service, in_service & ~valid, *(valid & (frame.status & bit > 0) for bit in bits)
        self._readings += [np.count_nonzero(kind) for kind in kinds]
        if self._complete_s is None:
            self._completeness.take(frame)
            if self._completeness.is_complete:
                self._complete_s = self._continuity.length_s

    def lines(self) -> Iterator[tuple[str, str]]:
        """Yield names and texts; without a frame nothing can be said of gaps and readings."""
        if not self._frames:
            yield "frames", "none"
            return
        length_s = self._continuity.length_s
        rate = f", {(self._frames - 1) / length_s:.2f} Hz" if length_s > 0 else ""
        yield "frames", f"{self._frames} in {length_s:.3f} s{rate}"
        yield "gaps", "; ".join(self._said_gaps()) or "none"
        of, *some = self._readings.tolist()
        shares = [f"{one / of:.2%}" if of else "none" for one in some]
        yield "readings", "{} invalid, {} held, {} saturated".format(*shares)
        yield "complete", self._complete()

    def _said_gaps(self) -> Iterator[str]:
        gaps, restarts = self._continuity.gaps, self._continuity.restarts
        if gaps.number:
            missing = f"{self._continuity.missing} frame periods without a frame"
            yield f"{gaps.number}, {missing}, {gaps.longest}"
        if restarts.number:
            where = "where the sequence begins anew (did the driver restart?)"
            yield f"{restarts.number} {where}, {restarts.longest}"

    def _complete(self) -> str:
        if self._complete_s is None:
            return f"never: no valid reading of {self._completeness.unread}"
        if not self._complete_s:
            return "from the first frame on"
        return (
            f"after {self._complete_s:.3f} s: until then a node that had not spoken was unknown; "
            "export --from-first-complete leaves that out"
        )
