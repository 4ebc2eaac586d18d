# SPDX-License-Identifier: Apache-2.0

"""A virtual digitizer that remembers the truth, and a socket to serve it on."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.nodes import NodeFrame
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Packet, Samples
from test.support.oracle import Stream

from ..connection.plug import Host

READY_S = 30.0
SPAN_S, WINDOW, KEPT = 5.0, 6, 14
"""The lag is kept by spans of SPAN_S, s. WINDOW spans are the 30 s of the driver's clock estimate;
KEPT spans outlast the effect of a late packet on it."""
_TURN_S = 1e-3


class Known(NamedTuple):
    """A true frame. epoch: counted from 0, one for every START and every time it fell behind.

    start_s: device time at which its first chip was sampled, s.
    """

    epoch: int
    start_s: float
    frame: NodeFrame


class KnownDigitizer(VirtualDigitizer):
    """Remembers the truth of every frame it sent, also where it could not keep up.

    born_s: host's monotonic time, s, at which its own clock read 0. samples_dropped: samples of
    packets that found no room. holes: how often it began to drop packets, or left out frames.
    """

    def __init__(self, options: SimOptions) -> None:
        super().__init__(options)
        # Streams, and how late each is: while a digitizer falls behind, its skin stands still.
        self._epochs: list[tuple[Stream, float]] = []
        self._lags_s = deque([(0.0, 0.0)], maxlen=KEPT)  # least and most, a SPAN_S each
        self._next_s = self._span_ends_s = self.born_s
        self.samples_dropped = self.holes = 0
        self._is_dropping = False

    @property
    def lag_s(self) -> float:
        """Largest delay of its own, for lack of processor time, in the last KEPT spans, s."""
        return max(most_s for _, most_s in self._lags_s)

    @property
    def least_lag_s(self) -> float:
        """Smallest delay of its own within the driver's clock window, s: the error of stamps."""
        return min(least_s for least_s, _ in list(self._lags_s)[-WINDOW:])

    def advance(self, wanted: int = 1) -> float:
        """See VirtualDigitizer."""
        begin_s = time.monotonic()
        lag_s = max(0.0, begin_s - self._next_s)
        if begin_s > self._span_ends_s:
            self._lags_s.append((lag_s, lag_s))
            self._span_ends_s = begin_s + SPAN_S
        least_s, most_s = self._lags_s[-1]
        self._lags_s[-1] = min(least_s, lag_s), max(most_s, lag_s)
        wait_s = super().advance(wanted)
        if wait_s:  # 0: it is behind
            self._next_s = time.monotonic() + wait_s
        if self.streaming:
            self._keep_epochs()
        return wait_s

    def _send(self, packet: Packet) -> None:
        before = self.packets_dropped
        super()._send(packet)
        dropped = self.packets_dropped > before
        self.holes += dropped and not self._is_dropping
        self.samples_dropped += dropped and isinstance(packet, Samples) and packet.counts.size
        self._is_dropping = dropped

    def _keep_epochs(self) -> None:
        if self._epochs:
            stream, late_s = self._epochs[-1]
            if self.started_s == stream.started_s + late_s:
                return
            if self.frames_lost:  # otherwise there was another START
                self.holes += 1
                self.streamed(stream, self.started_s - stream.started_s)
                return
        self.streamed(Stream(self.options, self.setup, self.started_s, self.turns))

    def streamed(self, stream: Stream, late_s: float = 0.0) -> None:
        """Note that these frames are sent from now on, late_s after the stream's own times."""
        self._epochs.append((stream, late_s))

    def frames_at(self, t_start: float) -> Iterator[Known]:
        """All true frames near this device time, s; the newest epoch first."""
        for epoch in range(len(self._epochs) - 1, -1, -1):
            stream, late_s = self._epochs[epoch]
            if (frame := stream.frame_at(t_start - late_s)) is not None:
                yield Known(epoch, stream.started_s + late_s + frame.start_s, frame)

    def spoke(self, epoch: int, first: int, stop: int) -> NDArray[np.bool_]:
        """(n,) bool: nodes that spoke in frames [first, stop) of an epoch."""
        return self._epochs[epoch][0].spoke(first, stop)


@contextmanager
def on_a_socket(digitizer: KnownDigitizer) -> Iterator[str]:
    """Serve it on a socket, whose kernel buffers hold many seconds; yields the port's URL."""
    stop, host = threading.Event(), Host()
    host.plug(digitizer)

    def run() -> None:
        while not stop.wait(_TURN_S):
            host.step()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield host.url
    finally:
        stop.set()
        thread.join(READY_S)
    host.unplug()
