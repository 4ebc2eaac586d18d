# SPDX-License-Identifier: Apache-2.0

"""Shows a skin in the terminal where there is no ROS: `make run`, then.

On a terminal it draws the skin live until Ctrl-C; otherwise, or with --seconds, it prints a line
per second. The last line has `key=value` pairs.
"""

import argparse
import math
import os
import shutil
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from tactile_cdma import Frame, Skin
from tactile_cdma.base.errors import TactileError
from tactile_cdma.config.parameters import read_file
from tactile_cdma.views.terminal import Look, Reading, scale, screen, status_lines

DRAW_PERIOD_S = 0.1
LOOK = Look(max_pa=140e3, coloured=not os.environ.get("NO_COLOR"))
HOME, CLEAR_BELOW, CLEAR_LINE = "\x1b[H", "\x1b[J", "\x1b[K"
ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"


def main() -> int:
    """Show the skin until interrupted or for some seconds; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", default="")
    parser.add_argument("--params", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=0.0)
    arguments = parser.parse_args()
    try:
        values = read_file(arguments.params)
        port = arguments.port or str(values.get("port", ""))
        # A slow machine that is also the simulator takes its time to begin.
        with Skin(**{**values, "port": port}, timeout_s=30.0) as skin, suppress(KeyboardInterrupt):
            return watch(skin, arguments.seconds)
    except TactileError as error:
        print(f"make run: {error}", file=sys.stderr)
        return 1
    return 0


def watch(skin: Skin, seconds: float) -> int:
    """Draw, or with a number of seconds print lines."""
    begin_s = shown_s = time.monotonic()
    received, lost, last = 0, 0, None
    period_s = 1.0 if seconds else DRAW_PERIOD_S
    sys.stdout.write("" if seconds else ENTER)
    try:
        while True:
            frame = skin.read()
            now_s = time.monotonic()
            lost += frame.sequence - last - 1 if last is not None else 0
            received, last = received + 1, frame.sequence
            if now_s - shown_s >= period_s:
                shown_s = now_s
                text = (
                    line(frame, now_s - begin_s, received, lost) if seconds else drawn(skin, frame)
                )
                print(text, end="\n" if seconds else "", flush=True)
            if seconds and now_s - begin_s >= seconds:
                break
    finally:
        sys.stdout.write("" if seconds else LEAVE)
        rate_hz = received / (time.monotonic() - begin_s)
        print(f"received={received} lost={lost} dropped={skin.dropped} rate_hz={rate_hz:.2f}")
    return 0


def line(frame: Frame, at_s: float, received: int, lost: int) -> str:
    """Show a frame in a line of text."""
    known = frame.pressure_pa[~np.isnan(frame.pressure_pa)]
    peak_kpa = known.max() / 1e3 if known.size else math.nan
    return (
        f"{at_s:5.1f} s  {received} frames  lost {lost}  peak {peak_kpa:6.1f} kPa  "
        f"{known.size}/{frame.pressure_pa.size} taxels valid"
    )


def drawn(skin: Skin, frame: Frame) -> str:
    """Draw a frame as a screen of text."""
    columns, lines = shutil.get_terminal_size()
    reading = Reading(frame.pressure_pa, frame.status, skin.layout.raster, skin.layout.nodes)
    notes = [
        scale(LOOK, columns),
        *status_lines(reading, LOOK, columns),
        "no ROS here: no topics; Ctrl-C ends",
    ]
    title = f"tactile_cdma  {skin.port}, kPa"
    text = screen(reading, LOOK, title, notes, columns, lines)
    return HOME + "\n".join(part + CLEAR_LINE for part in text) + CLEAR_BELOW


if __name__ == "__main__":
    sys.exit(main())
