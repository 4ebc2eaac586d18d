# SPDX-License-Identifier: Apache-2.0

"""What else may happen on the line than what the nodes of a sound skin say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .nodes import NodeFrame

Waveform = tuple[NDArray[np.float32], NDArray[np.float64]]
"""Levels (c,) V between edges (c + 1,) s."""


class Disturbance(Protocol):
    """Comes between the nodes and the converter, in frames of its choice."""

    def added(self, frame: NodeFrame, edges_s: NDArray[np.float64]) -> Iterator[Waveform]:
        """What adds up with what the nodes say; edges_s: (span_chips + 1,) of a nominal clock."""
        ...

    def disturbed(
        self, frame: NodeFrame, volts: NDArray[np.float32], t_s: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """What becomes of the line, (m,) V, at (m,) s since START; after the amplifier's input."""
        ...
