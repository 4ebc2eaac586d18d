# SPDX-License-Identifier: Apache-2.0

"""How a digitizer divides the line among packets, and when each is sent; docs/protocol.md."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Counts
from ..wire._protocol import MAX_PACKET_US, MAX_SAMPLES, TAIL_CHIPS, SyncMode
from .line import Disturbance, line_counts, truth
from .nodes import Turns
from .options import Setup, SimOptions
from .scene import Scene


@dataclass(frozen=True, slots=True)
class Block:
    """The samples of one packet.

    first_index: of the first sample, counted from START. counts: (m,) int16.
    sync: the first sample is the first of a frame. turn, asked: of that frame.
    quiet: sent as Quiet.
    begin_s: when the first sample is taken; if integrated, when its chip begins. due_s: when the
        packet is sent: as its last sample's period ends or, if it waits, with the packet after it.
        Both in s since START. waits: a silent gap after a silent frame.
    last: where frames are marked, of the frame's period: what comes next is of another one.
    """

    first_index: int
    counts: Counts
    sync: bool
    turn: int
    asked: bool
    quiet: bool
    begin_s: float
    due_s: float
    waits: bool
    last: bool


def stream(
    options: SimOptions,
    setup: Setup,
    turns: Turns | None = None,
    disturbance: Disturbance | None = None,
    scene: Scene | None = None,
) -> Iterator[Block]:
    """Yield all packets of samples since START, endlessly; a pure function of its arguments.

    Where frames are marked, each begins a new block and ends one; else blocks are of equal size.
    turns: may be asked for while blocks are drawn. scene: instead of the options' one.
    """
    rate_hz, marks = setup.rate_hz, setup.sync != SyncMode.NONE
    cutter = _Cutter(setup, options.channel.volts_per_count(setup.spec))
    instant = 0.0 if setup.integrated else 0.5  # of a sample within its period
    held = np.empty(0, dtype=np.int16)  # without marks: samples that fill no packet yet
    index, epoch_s = 0, 0.0
    for frame in truth(options, setup, turns, scene):
        whole = frame.start_s >= 0
        if setup.integrated:
            if not whole:
                continue  # it takes a frame mark to know where a chip begins
            epoch_s = frame.start_s - index / rate_hz
        counts = line_counts(options, setup, frame, disturbance)
        if not marks:
            counts = np.concatenate((held, counts))
            counts, held = np.split(counts, [len(counts) // cutter.gap_size * cutter.gap_size])
        marked = whole and marks
        for start, stop, quiet, waits in cutter.cuts(counts, marked):
            end = index + stop - start
            due = end + min(cutter.frame_size, MAX_SAMPLES) if waits else end
            begins = marked and start == 0
            yield Block(
                first_index=index,
                counts=counts[start:stop],
                sync=begins,
                turn=frame.turn if begins else 0,
                asked=frame.asked and begins,
                quiet=quiet,
                begin_s=epoch_s + (index + instant) / rate_hz,
                due_s=epoch_s + due / rate_hz,
                waits=waits,
                last=stop == len(counts),
            )
            index = end


class _Cutter:
    """Cuts one frame period after the other.

    gap_size: most samples of a packet outside of frames. frame_size: samples of a frame: its coded
    chips, or if raw its whole span and the tail.
    """

    def __init__(self, setup: Setup, volts_per_count: float) -> None:
        spec = setup.spec
        self.gap_size = min(MAX_SAMPLES, max(1, MAX_PACKET_US * round(setup.rate_hz) // 10**6))
        self.frame_size = spec.chips
        if not setup.integrated:
            self.frame_size = (spec.span_chips + TAIL_CHIPS) * setup.samples_per_chip
        quiet_counts = int(setup.quiet_uv * 1e-6 / volts_per_count)
        self._quiet_counts = 0 if setup.sync == SyncMode.NONE else quiet_counts

    def cuts(self, counts: Counts, marked: bool) -> Iterator[tuple[int, int, bool, bool]]:
        """Yield the packets of the samples from one frame's start to the next one's.

        marked: the first sample is a frame's, and known to be. Yields start and stop among these
        samples, and `quiet` and `waits` as in Block.
        """
        end = len(counts)
        frame_size = min(self.frame_size, end) if marked else 0
        silent = frame_size > 0 and self._quiet(counts[:frame_size])
        waits = silent and frame_size < end and self._quiet(counts[frame_size:])
        most = frame_size if silent else MAX_SAMPLES
        for start in range(0, frame_size, most):
            yield start, min(start + most, frame_size), silent, False
        most = end if waits else self.gap_size
        for start in range(frame_size, end, most):
            stop = min(start + most, end)
            yield start, stop, self._quiet(counts[start:stop]), waits

    def _quiet(self, counts: Counts) -> bool:
        """Tell whether the samples differ by so little that a Quiet stands for them."""
        return 0 < self._quiet_counts >= int(counts.max()) - int(counts.min())
