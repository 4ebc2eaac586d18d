# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
