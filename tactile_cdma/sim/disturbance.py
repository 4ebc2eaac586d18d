# SPDX-License-Identifier: Apache-2.0

"""Faults on the line, made by tests: signals that no node of a sound skin sends."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from ..base.arrays import Floats, Floats32
from .nodes import NodeFrame

Waveform = tuple[Floats32, Floats]
"""Levels (c,) V between edges (c + 1,) s."""


class Disturbance(Protocol):
    """Comes between the nodes and the converter, in frames of its choice."""

    def added(self, frame: NodeFrame, edges_s: Floats) -> Iterator[Waveform]:
        """Waveforms to add to those of the nodes; edges_s: (span_chips + 1,), nominal."""
        ...

    def disturbed(self, frame: NodeFrame, volts: Floats32, t_s: Floats) -> Floats32:
        """The line, (m,) V at (m,) s since START, as it reaches the amplifier."""
        ...
