# SPDX-License-Identifier: Apache-2.0

"""Keeps the nodes' clocks and the decorrelator built from them, in a thread beside the stream."""

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ..base.arrays import Floats32
from ..base.errors import TactileError
from ..base.text import listed
from ..code.frame import FrameSpec
from .clock_tracking import REBUILD, ClockTracker
from .decorrelate import Decorrelator
from .node_clocks import NodeClocks, needs_decorrelation
from .roll_call import RollCallListener

_log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ClockReport:
    """What is known of the nodes' clocks.

    heard: number of nodes that a roll call has measured. spread_chips: largest difference of two
    nodes within a frame, chips. decorrelated: whether frames are taken apart by least squares.
    unresolved: nodes, from 1 on, that cannot be told from others. busy: a roll call is under way or
    being evaluated. problem: why clocks are not used, or not all of them; None if they are.
    """

    heard: int = 0
    spread_chips: float = 0.0
    decorrelated: bool = False
    unresolved: tuple[int, ...] = ()
    busy: bool = False
    problem: str | None = None


class ClockKeeper:
    """From roll calls to clocks to a decorrelator, which follows the clocks while they drift.

    report: what is known now. decorrelator: takes frames apart; None where correlation does.
    """

    def __init__(self, spec: FrameSpec, per_chip: float, background: bool) -> None:
        """background: work in a thread beside the stream.

        Else at once, so that the same samples always give the same frames.
        """
        self.report = ClockReport()
        self.decorrelator: Decorrelator | None = None
        self.listener = RollCallListener(spec, per_chip)
        self._spec, self._per_chip = spec, per_chip
        self._tracker: ClockTracker | None = None
        self._worker = ThreadPoolExecutor(1, "node clocks") if background else None
        self._coming: Future[Decorrelator | None] | None = None

    @property
    def settled(self) -> bool:
        """Whether no work on the clocks is under way."""
        return self._coming is None and not self.report.busy

    def begin(self) -> None:
        """Begin a roll call."""
        _log.debug("a roll call begins")
        self.listener = RollCallListener(self._spec, self._per_chip)
        self.report = replace(self.report, busy=True, problem=None)

    def hear(self, node: int, line: Floats32, noise_rms_v: float) -> None:
        """Take in a node's frame of a roll call; see RollCallListener.hear."""
        self._submit(self.listener.hear, node, line, noise_rms_v)

    def conclude(self) -> None:
        """Evaluate the roll call, which is over."""
        self._coming = self._submit(self._judge, self.listener)

    def follow(
        self, decorrelator: Decorrelator, line: Floats32, words: Floats32, noise_rms_v: float
    ) -> None:
        """Learn from a decoded frame, unless other work is under way; see ClockTracker.update."""
        if self._coming is None:
            self._coming = self._submit(self._track, decorrelator, line, words, noise_rms_v)

    def adopt(self) -> None:
        """Switch to a decorrelator that has become ready."""
        if self._coming is None or not self._coming.done():
            return
        try:
            decorrelator = self._coming.result()
        except TactileError as error:
            self.give_up(str(error))
        else:
            self.decorrelator = decorrelator
        self._coming = None

    def give_up(self, problem: str) -> None:
        """Forget the clocks, for this reason."""
        _log.debug("the nodes' clocks are forgotten: %s", problem)
        self.decorrelator = self._tracker = None
        self.report = ClockReport(problem=problem)

    def close(self) -> None:
        """Cancel pending work."""
        if self._worker is not None:
            self._worker.shutdown(wait=False, cancel_futures=True)

    def _judge(self, listener: RollCallListener) -> Decorrelator | None:
        """Evaluate a roll call; returns a decorrelator if the clocks need one."""
        clocks = listener.clocks()
        if not clocks.known.any():
            nobody = "no node was heard alone in the roll call"
            self.report = replace(self.report, busy=False, problem=nobody)
            return self.decorrelator
        problem: str | None = None
        if missing := (np.flatnonzero(~clocks.known) + 1).tolist():
            problem = f"not heard alone in the roll call: {listed(missing, 'node')}"
        self._tracker = ClockTracker(clocks)
        return self._use(clocks, problem, needs_decorrelation(self._spec, clocks))

    def _track(
        self, decorrelator: Decorrelator, line: Floats32, words: Floats32, noise_rms_v: float
    ) -> Decorrelator | None:
        """Follow the clocks; returns the decorrelator to use from now on."""
        if self._tracker is None:
            return decorrelator
        self._tracker.update(decorrelator, line, words, noise_rms_v)
        clocks = self._tracker.clocks
        if clocks.moved_chips(decorrelator.clocks, self._spec) > REBUILD:
            return self._use(clocks, self.report.problem)
        return decorrelator

    def _use(
        self, clocks: NodeClocks, problem: str | None, decorrelated: bool = True
    ) -> Decorrelator | None:
        """Build a decorrelator for these clocks, if wanted, and report."""
        built = Decorrelator(self._spec, clocks, self._per_chip) if decorrelated else None
        unresolved = tuple((built.unresolved + 1).tolist()) if built else ()
        heard, spread = int(clocks.known.sum()), clocks.spread_chips(self._spec)
        self.report = ClockReport(heard, spread, decorrelated, unresolved, problem=problem)
        _log.debug("the nodes' clocks: %s", self.report)
        return built

    def _submit(self, work: Callable[..., T], *arguments: object) -> Future[T]:
        """Do work, one piece after the other, beside the stream or at once."""
        if self._worker is not None:
            return self._worker.submit(work, *arguments)
        done: Future[T] = Future()
        try:
            done.set_result(work(*arguments))
        except TactileError as error:
            done.set_exception(error)
        return done
