# SPDX-License-Identifier: Apache-2.0

"""What viewers in a terminal share: its screen, keys, and the curve of force or peak."""

import math
import os
import select
import shutil
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Floats32
from ..base.program import Drawn
from ..base.text import escaped
from ..places.layout import Layout
from ..readings.status import Status, is_in_service
from ..readings.taxels import Coverage
from .terminal import Look, Numbers, Reading, scale, screen, sparkline, status_lines

DRAW_PERIOD_S = 0.1
"""Chosen: 10 pictures a second look alive, and a terminal over a network keeps up."""
OLD_S = 1.0
"""Time without a frame, s, after which the last one no longer counts as a reading; chosen."""
HISTORY_S = 20.0
"""Time that the curve shows; chosen."""
LEAST_SCALE_PA, MOST_SCALE_PA = 100.0, 1e8
KEY_HELP = "n numbers   h force/peak   + - scale   q ends"
_HOME, _CLEAR_BELOW, _CLEAR_LINE = "\x1b[H", "\x1b[J", "\x1b[K"
_ENTER, _LEAVE = Drawn("\x1b[?1049h\x1b[?25l"), Drawn("\x1b[?25h\x1b[?1049l")


def look_for(encoding: str, max_pa: float) -> Look:
    """Find what the terminal can show, and its user wants: NO_COLOR, see no-color.org."""
    unicode = encoding.lower().replace("-", "").startswith("utf")
    return Look(max_pa, coloured=not os.environ.get("NO_COLOR"), unicode=unicode)


def can_draw() -> bool:
    """Tell whether a terminal is there, to draw on and to type at."""
    return sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get("TERM", "") != "dumb"


def over(lines: list[str]) -> Drawn:
    """Return the text that draws these lines over the last ones."""
    safe = (line if isinstance(line, Drawn) else escaped(line) for line in lines)
    return Drawn(_HOME + "\n".join(line + _CLEAR_LINE for line in safe) + _CLEAR_BELOW)


def page(
    reading: Reading, look: Look, size: os.terminal_size, title: str, *above: str, below: list[str]
) -> Drawn:
    """Draw a frame, with lines above its scale, below that, and lists of its taxels."""
    columns = size.columns
    lists = status_lines(reading, look, columns)
    notes = [*filter(None, above), scale(look, columns), *below, *lists, KEY_HELP]
    return over(screen(reading, look, title, notes, columns, size.lines))


def live(
    look: Look, goes_on: Callable[[], bool], drawn: Callable[[Look, bool, os.terminal_size], Drawn]
) -> None:
    """Draw until it does not go on, or a key ends it; then the terminal shows what it did before.

    goes_on: waits for DRAW_PERIOD_S. drawn: returns the screen; its second argument False: with the
    curve of the peak, not of the force.
    """
    of_force = True
    sys.stdout.write(_ENTER)
    try:
        with typed_keys() as keys:
            while goes_on() and "q" not in (pressed := keys()):
                for key in pressed:
                    look, of_force = obeyed(key, look, of_force)
                sys.stdout.write(drawn(look, of_force, shutil.get_terminal_size()))
                sys.stdout.flush()
    finally:
        sys.stdout.write(_LEAVE)
        sys.stdout.flush()


@contextmanager
def typed_keys() -> Iterator[Callable[[], str]]:
    """Have stdin, a terminal, deliver keys at once and not echo them.

    Yields a function that returns the keys pressed since its last call.
    """
    try:
        import termios
        import tty
    except ImportError:  # Windows
        console: Any = import_module("msvcrt")
        yield lambda: "".join(iter(lambda: console.getwch() if console.kbhit() else "", ""))
        return
    stdin = sys.stdin.fileno()
    before = termios.tcgetattr(stdin)

    def read() -> str:
        if not select.select([stdin], [], [], 0)[0]:
            return ""
        return os.read(stdin, 64).decode("ascii", errors="ignore")

    tty.setcbreak(stdin)  # Ctrl-C still interrupts
    try:
        yield read
    finally:
        termios.tcsetattr(stdin, termios.TCSADRAIN, before)


def obeyed(key: str, look: Look, of_force: bool) -> tuple[Look, bool]:
    """Return what a key changes: the look, and whether the force's history is shown."""
    if key == "n":
        after = {None: Numbers.TAXELS, Numbers.TAXELS: Numbers.NODES, Numbers.NODES: None}
        return replace(look, numbers=after[look.numbers]), of_force
    if key in "+-":
        max_pa = look.max_pa * (2.0 if key == "+" else 0.5)
        return replace(look, max_pa=min(max(max_pa, LEAST_SCALE_PA), MOST_SCALE_PA)), of_force
    return look, of_force != (key == "h")


class Course:
    """Keeps force, N, and peak, Pa, of the last seconds, and what of the newest frame is read."""

    def __init__(self) -> None:
        self.coverage = Coverage()
        self._force_n, self._peak_pa = History(HISTORY_S), History(HISTORY_S)

    def add(
        self, now_s: float, pressure_pa: Floats32, status: NDArray[np.uint8], layout: Layout | None
    ) -> None:
        """Add a frame; without its layout its force is not known."""
        self.coverage = Coverage.of(pressure_pa, status)
        self._peak_pa.add(now_s, float(np.fmax.reduce(pressure_pa)))
        if layout is not None and len(layout) == len(pressure_pa):
            self._force_n.add(now_s, force_n(pressure_pa, status, layout.areas_m2))

    def line(self, of_force: bool, is_of_now: bool, columns: int, unicode: bool) -> str:
        """Draw force or peak: name, value now (>: some taxels are not read), curve, maximum."""
        name, per_unit, unit = ("force", 1.0, "N") if of_force else ("peak", 1e-3, "kPa")
        history = self._force_n if of_force else self._peak_pa
        values = history.bins(time.monotonic(), max(1, min(60, columns - 30))) * per_unit
        known = values[~np.isnan(values)]
        now, top = "--", f"{known.max():.2f}" if known.size else "--"
        if not math.isnan(history.latest) and is_of_now:
            now = f"{'' if self.coverage.is_whole else '> '}{history.latest * per_unit:.2f}"
        return f"{name} {now} {unit}  {sparkline(values, unicode)}  of {top}"


def unread(pressure_pa: Floats32, status: NDArray[np.uint8]) -> None:
    """Turn all taxels in service to such that are not heard."""
    pressure_pa[:] = np.nan
    status[is_in_service(status)] = Status.STALE | Status.SILENT


def force_n(pressure_pa: Floats32, status: NDArray[np.uint8], areas_m2: Floats32) -> float:
    """Sum pressure × area, N: a lower bound unless all is read; NaN where most is not, or no area.

    pressure_pa, status, areas_m2: (t,).
    """
    if not (Coverage.of(pressure_pa, status).is_most and (areas_m2 > 0).all()):
        return math.nan
    return float(np.nansum(pressure_pa * areas_m2))


class History:
    """Keeps the values of the last span_s seconds."""

    def __init__(self, span_s: float) -> None:
        self.span_s = span_s
        self._values: deque[tuple[float, float]] = deque()

    def add(self, now_s: float, value: float) -> None:
        """Append a value (NaN: unknown) at a time that never decreases, s."""
        self._values.append((now_s, value))
        while now_s - self._values[0][0] > self.span_s:
            self._values.popleft()

    @property
    def latest(self) -> float:
        """Return the value added last; NaN: unknown, or none yet."""
        return self._values[-1][1] if self._values else math.nan

    def bins(self, now_s: float, count: int) -> Floats:
        """Return the maximum in each of count equal parts of the span, (count,); NaN: no value.

        The last part ends now. Maxima keep short peaks visible.
        """
        t_s, values = np.array(self._values).reshape(-1, 2).T
        part = count - 1 - np.floor((now_s - t_s) / self.span_s * count).astype(int)
        inside = (part >= 0) & (part < count)
        greatest = np.full(count, np.nan)
        np.fmax.at(greatest, part[inside], values[inside])
        return greatest
