# SPDX-License-Identifier: Apache-2.0

"""Emulated nodes with the RP2040's image: an `EmulatedSkin` with a digitizer's real firmware."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulated import Amplifier, EmulatedNodes, Node
from rp2040 import PIN_HEARD, Bus, Rp2040

IMAGE = Path(__file__).resolve().parents[1] / "build" / "rp2040" / "digitizer.bin"
FULL_SCALE_V = 3.3
COUNTS = 4096


class Rp2040Skin(EmulatedNodes):
    """Emulates nodes and the RP2040 that drives their sync line and samples their line.

    The host is connected by USB. clock_error: relative error of the RP2040's crystal; 50e-6 is
    50 ppm fast, so that `chip.now` is ahead of `now_ns`.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        amplifier: Amplifier | None = None,
        bus: Bus | None = None,
        clock_error: float = 0.0,
    ) -> None:
        self.chip = Rp2040(IMAGE, self._counts, self._edge, bus=bus)
        self._rate = 1 + clock_error
        super().__init__(nodes, amplifier)
        self.chip.plug_usb()
        self.pulses_ns: list[int] = []
        """Times of the rising edges of the sync pin."""
        self.edges_ns: list[tuple[int, bool]] = []
        """Times of all its edges, and whether they rise."""

    def close(self) -> None:
        """End the emulator, free the nodes. May be called twice."""
        self.chip.close()
        super().close()

    @property
    def now_ns(self) -> int:
        """Tell how far the emulation has come."""
        return round(self.chip.now / self._rate * 1e9)

    def run(self, t_ns: int) -> None:
        """Run digitizer and nodes to a time."""
        self.chip.run(t_ns * self._rate * 1e-9)
        super().run(t_ns)

    def write(self, data: bytes) -> None:
        """Pass bytes from the host to the digitizer."""
        self.chip.write_usb(data)

    def read(self) -> bytes:
        """Return the next frame in order, waited for."""
        return self.chip.read_usb()

    def hear(self, edges_ns: Iterable[tuple[int, bool]]) -> None:
        """Wire the pin that hears to another one's sync line, whose edges these are."""
        self.chip.drive(PIN_HEARD, ((t_ns * self._rate * 1e-9, up) for t_ns, up in edges_ns))

    def _edge(self, t_ns: float, level: bool) -> None:
        t_ns = round(t_ns / self._rate)
        if level:
            self.pulses_ns.append(t_ns)
        self.edges_ns.append((t_ns, level))
        self.sync(t_ns, level)

    def _counts(self, times_ns: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Return the ADC's counts of the line at evenly spaced times."""
        times_ns = times_ns / self._rate
        super().run(int(times_ns[-1]))
        step_ns = times_ns[1] - times_ns[0] if len(times_ns) > 1 else 0.0
        volts = self.volts(times_ns[0], step_ns, len(times_ns))
        counts = np.floor(volts / FULL_SCALE_V * COUNTS)
        return np.clip(counts, 0, COUNTS - 1).astype(np.uint16)
