# SPDX-License-Identifier: Apache-2.0

"""Loads taken from a live skin, step by step: load it, say by how much, press Enter."""

import queue
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from ..base.arrays import Floats, Floats32
from ..base.errors import CalibrationError, PortError
from ..base.named_file import naming, read_text
from ..base.text import listed
from ..driver.driver import Driver
from ..driver.pipeline import TactileFrame
from .load_points import HEADING, MOST_BYTES, point_lines
from .plateaus import LEAST_FRAMES, steady_voltage

PATIENCE_S = 5.0
"""Wait for a frame before a step is given up, s; chosen: ports open in one or two."""
MOVED = 2.0
"""A node has moved if its reading changes by more, LSB: a flickering code changes by one."""


@dataclass(frozen=True)
class LoadSession:
    """The dialogue on the terminal: every load that is accepted is in the file at once.

    frames: filled by the driver. nodes: numbers of those that are loaded. seconds: how long each
    load is measured.
    """

    driver: Driver
    frames: queue.SimpleQueue[TactileFrame]
    lsb_v: float
    nodes: Sequence[int]
    seconds: float

    def run(self, path: Path, steps_kpa: Sequence[float], append: bool) -> int:
        """Take loads until the steps, or the answers, are at an end; returns how many were taken.

        steps_kpa: loads to ask for; empty: whatever is answered.
        Raises CalibrationError where the file exists already, is another kind of table or cannot be
        written, or no load was taken; PortError where the skin is not heard.
        """
        if path.exists() and not append:
            raise CalibrationError(
                f"{path}: exists already: add to it with --append, or leave out the port to fit it"
            )
        with naming(path, CalibrationError):
            text = read_text(path, MOST_BYTES) if path.exists() else ""
            if text and text.splitlines()[0].strip() != HEADING:
                raise CalibrationError(
                    f"{path}: begins with {text[:40]!r}; points can only follow the heading "
                    f"{HEADING}"
                )
            file = path.open("a" if append else "x", encoding="utf-8")
        with naming(path, CalibrationError), file:
            try:
                file.write("\n" if text and not text.endswith("\n") else "")
                taken = self._take(file, steps_kpa)
            finally:
                if not file.tell() and path.is_file():
                    path.unlink()
        if not taken:
            raise CalibrationError("no load was taken")
        return taken

    def _take(self, file: TextIO, steps_kpa: Sequence[float]) -> int:
        self._collect(0.0)  # raises before anybody loads a skin that is not heard
        before_v: Floats | None = None
        taken = 0
        while (load_kpa := self._next(taken, steps_kpa)) is not None:
            voltage_v = self._settled()
            if voltage_v is None:
                continue
            if not file.tell():
                file.write(HEADING + "\n")
            file.write(point_lines(list(self.nodes), load_kpa * 1e3, voltage_v))
            file.flush()
            taken += 1
            print(f"{load_kpa:g} kPa: {self._summary(voltage_v, before_v)}", flush=True)
            before_v = voltage_v
        return taken

    def _next(self, taken: int, steps_kpa: Sequence[float]) -> float | None:
        """Return the load that is on the skin now, kPa; None: no more."""
        who = f"node {self.nodes[0]}" if len(self.nodes) == 1 else "all nodes"
        question = f"load {taken + 1}, in kPa, applied to {who} (Enter: end) "
        answers: dict[str, float | None] = {"": None}
        if steps_kpa:
            if taken == len(steps_kpa):
                return None
            load_kpa = steps_kpa[taken]
            question = f"load {taken + 1} of {len(steps_kpa)}: apply {load_kpa:g} kPa to {who}, "
            question += "then Enter (e: end) "
            answers = {"": load_kpa, "e": None}
        while True:
            try:
                answer = input(question).strip().lower()
            except EOFError:
                return None
            if answer in answers:
                return answers[answer]
            with suppress(ValueError):
                if 0 <= (value := float(answer.replace(",", "."))) < np.inf:
                    return value
            print(f"{answer!r} is not a pressure in kPa", flush=True)

    def _collect(self, seconds: float) -> Floats32:
        """Take the voltages of the next seconds' frames, (f, n) V, NaN where a node is not heard.

        Raises PortError, with the driver's reason, where too few frames come.
        """
        begin_s = time.monotonic()
        deadline_s, rows = begin_s + seconds + PATIENCE_S, list[Floats32]()
        while time.monotonic() < deadline_s:
            with suppress(queue.Empty):
                frame = self.frames.get(timeout=0.1)
                if frame.t_host >= begin_s:
                    rows.append(frame.readings.certain_voltage_v)
                if frame.t_host >= begin_s + seconds and len(rows) >= LEAST_FRAMES:
                    return np.array(rows)
        raise PortError(self.driver.problem or "too few frames come; is the skin connected?")

    def _settled(self) -> Floats | None:
        """Return voltages of the nodes, (k,) V, NaN where not heard; None where they still move."""
        lsb_v, frames = self.lsb_v, self._collect(self.seconds)[:, np.array(self.nodes) - 1]
        begin_v, end_v = (steady_voltage(half, lsb_v) for half in np.array_split(frames, 2))
        change_v = np.abs(end_v - begin_v)
        moving = change_v > MOVED * lsb_v  # False for a node that was not heard
        voltage_v = steady_voltage(frames, lsb_v)
        if moving.any():
            worst = int(np.nanargmax(change_v))
            problem = (
                f"{np.count_nonzero(moving)} of {len(self.nodes)} nodes still move, node "
                f"{self.nodes[worst]} by {change_v[worst] * 1e3:.0f} mV within "
                f"{self.seconds / 2:g} s; wait, then answer again"
            )
        elif not np.isfinite(voltage_v).any():
            problem = "no node is heard"
        else:
            return voltage_v
        print(f"not taken: {problem}", flush=True)
        return None

    def _summary(self, voltage_v: Floats, before_v: Floats | None) -> str:
        low_v, high_v = np.nanmin(voltage_v), np.nanmax(voltage_v)
        parts = [f"{low_v:.3f} V" if len(self.nodes) == 1 else f"{low_v:.3f} to {high_v:.3f} V"]
        silent = np.isnan(voltage_v)
        groups = {"not heard": silent}
        if before_v is not None:
            moved = np.abs(voltage_v - before_v) > MOVED * self.lsb_v
            parts.append(f"{np.count_nonzero(moved)} of {len(self.nodes)} nodes moved")
            groups = {"not moved": ~moved & ~silent, "not heard": silent}
        for what, where in groups.items():
            if found := [self.nodes[i] for i in np.flatnonzero(where).tolist()]:
                parts.append(f"{what}: {listed(found, 'node')}")
        return ", ".join(parts)
