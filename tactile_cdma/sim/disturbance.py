# SPDX-License-Identifier: Apache-2.0

"""Faults on the line, made by tests: signals that no node of a sound skin sends."""

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
        """Waveforms to add to those of the nodes; edges_s: (span_chips + 1,), nominal."""
        ...

    def disturbed(
        self, frame: NodeFrame, volts: NDArray[np.float32], t_s: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """The line, (m,) V at (m,) s since START, as it reaches the amplifier."""
        ...
