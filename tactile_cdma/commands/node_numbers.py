# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma node --enumerate PORT`: asks which taxel to press, until all nodes have numbers."""

import math
import queue
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..base.errors import LayoutError, PortError
from ..base.interrupt import terminable
from ..base.named_file import naming
from ..base.whole_file import replace_file
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline
from ..driver.session import Session
from ..hardware.numbering import Numbering
from ..places.layout import Layout
from ..places.layout_file import SCHEMA, VERSION
from ..wire._protocol import PacketType
from ..wire.discovery import leave_alone_if_open
from ..wire.messages import Number
from ..wire.port import Port

AGAIN_S = 0.5
"""s after which a request is repeated: a digitizer that was restarted announces nothing. Chosen."""
UNREAD_S, SILENT_S = 0.7, 5.0
"""s without a frame after which many nodes may speak on one row; and after which it ends. Chosen,
the latter as skin.TIMEOUT_S."""
KEYS = "b: the last one was wrong   s: leave this one out   q: end   (then Enter)"


def run(url: str, baud: int, config: SkinConfig, layout_file: Path | None) -> int:
    """Number the nodes at a port with a person at the terminal; returns the exit code."""
    leave_alone_if_open(url)
    if layout_file is not None:
        check_grid(layout_file, config.layout)  # before anybody presses anything
    typed: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_type, args=(typed,), daemon=True).start()
    with terminable(), Port(url, baud) as port:
        numbering = enumerate_nodes(port, config, typed, lambda text: print(text, flush=True))
    if numbering.asked is not None:
        kept = f"; {layout_file} is not written" if layout_file else ""
        print(f"ended before node {numbering.asked} had its number{kept}", file=sys.stderr)
        return 1
    if layout_file is not None:
        write_numbered(layout_file, config.layout, numbering.skipped)
        print(f"written: {layout_file}")
    return 0


def _type(typed: "queue.Queue[str]") -> None:
    for line in sys.stdin:
        typed.put(line)


def enumerate_nodes(
    port: Port, config: SkinConfig, typed: "queue.Queue[str]", tell: Callable[[str], None]
) -> Numbering:
    """Number the nodes until all were asked for, or q was typed; PortError: without frames."""
    numbering, session, pipeline = Numbering(config.spec.nodes), Session(config), Pipeline(config)
    on_key = {"b": numbering.back, "s": numbering.skip}
    announced, said_s, heard_s, prompted = Number(0), -np.inf, np.inf, 0
    tell(KEYS)
    port.write(session.open())
    try:
        while numbering.asked is not None or numbering.request.forget:
            data, now_s = port.read()
            heard_s = min(heard_s, now_s)
            for frame in pipeline.feed(data, now_s):
                heard_s = now_s
                if text := numbering.take(frame.words):
                    tell(text)
            _check(pipeline, session, silent_s=now_s - heard_s)
            if now_s - heard_s > UNREAD_S and numbering.waits:
                tell(numbering.unclear())
            if not typed.empty():
                if (key := typed.get().strip().lower()) == "q":
                    break
                tell(on_key[key]() if key in on_key else KEYS)
                prompted = 0
            waited_for = numbering.asked if numbering.waits else None
            if waited_for and waited_for != prompted:
                tell(prompt(config.layout, waited_for))
            prompted = waited_for or 0
            if request := session.watch(pipeline, now_s):
                port.write(request)
            if pipeline.counters.frames and (
                numbering.request != announced or now_s - said_s > AGAIN_S
            ):
                announced, said_s = numbering.request, now_s
                port.write(session.encoded(announced))
    finally:
        port.write(session.encoded(Number(0)) + session.close())
    return numbering


def _check(pipeline: Pipeline, session: Session, silent_s: float) -> None:
    """Raise PortError where there was no frame for too long, or numbers are not announced."""
    if silent_s > SILENT_S:
        why = pipeline.problem or session.problem or "the digitizer sends no frames"
        raise PortError(f"no frame for {SILENT_S:g} s: {why}")
    if (refusal := pipeline.digitizer.refusal) and refusal.command == PacketType.NUMBER:
        raise PortError(
            f"the digitizer announces no numbers ({refusal.result.name.lower()}): its firmware is "
            "older, it is a demonstrator or simulated, or the pause between frames is below 2.2 ms"
        )


def prompt(layout: Layout, number: int) -> str:
    """Tell which taxel to press."""
    [taxel, *_] = [*np.flatnonzero(layout.nodes == number), -1]
    if taxel < 0:
        return f"node {number} has no place in the layout: press it, or leave it out"
    x_mm, y_mm, z_mm = layout.positions_m[taxel] * 1e3
    where = f"x {x_mm:.1f}, y {y_mm:.1f}, z {z_mm:.1f} mm"
    if not layout.irregular:
        where = f"row {taxel // layout.columns + 1}, column {taxel % layout.columns + 1} ({where})"
    return f"press the taxel of node {number}: {where}"


def check_grid(path: Path, layout: Layout) -> None:
    """Raises LayoutError for a skin, or a place, of which no layout file can be written."""
    if layout.irregular or np.ptp(layout.positions_m[:, 2]) > 0:
        raise LayoutError(
            f"{path}: the skin is not a flat grid; leave --layout out, and edit its file"
        )
    if path.is_dir() or not path.parent.is_dir():
        raise LayoutError(f"{path}: is a folder, or lies in a folder that does not exist")


def write_numbered(path: Path, layout: Layout, skipped: list[int]) -> None:
    """Write a flat grid's layout file without the nodes that nobody has; LayoutError: all."""
    nodes = np.where(np.isin(layout.nodes, skipped), 0, layout.nodes)
    if not nodes.any():
        raise LayoutError(f"{path}: not written: all nodes were left out")
    pitches_mm = [round(pitch_m * 1e3, 6) for pitch_m in layout.pitches_m]
    content = {
        "schema": SCHEMA,
        "version": VERSION,
        "name": layout.name,
        "shape": "grid",
        "rows": layout.rows,
        "columns": layout.columns,
        "pitch_mm": pitches_mm if pitches_mm[0] != pitches_mm[1] else pitches_mm[0],
        "masked": sorted({*layout.masked} - {*skipped}),
        "unplaced": sorted({*layout.unplaced, *skipped}),
        "nodes": nodes.reshape(layout.rows, layout.columns).tolist(),
    }
    style: dict[str, Any] = {"default_flow_style": None, "width": math.inf}  # a line for each row
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, **style)
    with naming(path, LayoutError):
        replace_file(path, text)
