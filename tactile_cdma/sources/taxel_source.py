# SPDX-License-Identifier: Apache-2.0

"""What a source is, and how one is found by the scheme of its URL."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools
from ..base.errors import PortError
from ..wire.identity import BUILT_IN, SOURCES, scheme_of


@dataclass(frozen=True, slots=True)
class TaxelFrame:
    """One reading of all taxels, in the order of the nodes.

    values: (n,) ADC codes; V of a source with full_scale_v; NaN without a reading.
    t_host: when its last byte was read, s on the host's monotonic clock.
    t_device: when it was measured, s on a clock of the sensor's own; None: when it was read.
    number: counts the frames that the sensor made; None: none is lost between this and the last.
    valid: (n,) bool, which taxels have a reading; None: those that are not NaN.
    """

    values: NDArray[np.floating | np.integer]
    t_host: float
    t_device: float | None = None
    number: int | None = None
    valid: Bools | None = None


class TaxelSource(Protocol):
    """Reads a sensor; it is open when it is made.

    bits: of its codes; None: as the parameter says. full_scale_v: V that the code after the highest
    one would stand for, where its values are volts; None: they are codes.
    problem: why no frames come, in one sentence; None: nothing is known to be wrong.
    """

    bits: int | None
    full_scale_v: float | None

    @property
    def problem(self) -> str | None: ...

    def read(self, nodes: int | None) -> Sequence[TaxelFrame]:
        """Wait up to 0.1 s for frames; raises PortError where the sensor is lost.

        nodes: how many taxels a frame has to have; None: as many as come.
        """

    def close(self) -> None: ...


def open_source(url: str) -> TaxelSource:
    """Open the source that a URL names; raises PortError, and SpecError for a wrong option."""
    scheme = scheme_of(url)
    if scheme not in BUILT_IN:
        for point in entry_points(group=SOURCES, name=scheme):
            source: TaxelSource = point.load()(url)
            return source
        raise PortError(f"{url}: no installed package has a source {scheme!r} ({SOURCES})")
    from .flexitac import FlexiTac  # these import what stands above
    from .text import TextLines

    return TextLines(url) if scheme == "text" else FlexiTac(url)
