# SPDX-License-Identifier: Apache-2.0

"""Examines a port: whether a digitizer is there, the right one, with a sound skin."""

import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from ..base.errors import PortError, TactileError
from ..config.parameters import DEFAULTS, SIMULATION, Value, Values, read_file
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline
from ..driver.session import Session
from ..hardware.node_memory import usual_heartbeat
from ..recording.offline import parameters_of
from ..wire.discovery import leave_alone_if_open
from ..wire.introduction import described_info, introduction
from ..wire.port import Port
from .report import Check, ok, problem, warning
from .stream import Chunks, certified, judge

_log = logging.getLogger(__name__)

START_S = 3.5
START_FRAMES = 4
"""s and frame periods; within their sum the first frame has to come. Chosen: the session asks a
digitizer that does not answer several times."""
MOST_BYTES = 64 << 20
"""Held in memory at most; chosen: 16 s of the fastest skin, at 4.1 MB/s."""


def examine(
    url: str | None, params: Path | None, baud: int | None, seconds: float
) -> Iterator[Check]:
    """Run all checks of a port, or of the one that a parameter file names."""
    try:
        values = read_file(params) if params is not None else None
        if values is not None:
            yield _parameters(SkinConfig.of(values), f"{params}")
    except TactileError as error:
        yield problem("parameters", str(error))
        return
    get: Values = {**DEFAULTS, **(values or {})}
    url = url or get["port"] or SIMULATION
    try:
        leave_alone_if_open(url)
        with Port(url, baud or get["baud"]) as port:
            yield ok("port", f"{url} opened")
            if port.held_back:
                yield warning("latency", port.held_back)
            yield from _examine(port, values, seconds)
    except PortError as error:
        yield problem("port", str(error))
    except TactileError as error:
        yield problem("digitizer", str(error))


def _parameters(config: SkinConfig, file: str) -> Check:
    """Check whether nodes at rest, as usually written, speak before they count as stale."""
    period_s = config.spec.frame_period_s
    silent_s = usual_heartbeat(period_s) * period_s
    if silent_s < config.stale_after_s:
        return ok("parameters", file)
    return warning(
        "parameters",
        f"{file}: stale_after_s is {config.stale_after_s:g} s, but nodes at rest speak every "
        f"{silent_s:.3g} s unless told otherwise (tactile-cdma node --heartbeat): make it longer",
    )


def _examine(port: Port, values: dict[str, Value] | None, seconds: float) -> Iterator[Check]:
    """Examine an open port; values: those of the parameter file, None without one."""
    info = introduction(port)
    described = {**parameters_of(info), "amplitude_mv": 0.0}
    config = SkinConfig.of(described if values is None else values)
    if wrong := config.refusal(info.digitizer_id):
        yield problem("digitizer", wrong)
        return
    configure = values is not None
    yield ok("digitizer", described_info(info, "was set to" if configure else "set to"))
    pipeline = Pipeline(config)
    chunks, no_frames = _listen(port, pipeline, configure, seconds)
    yield from judge(chunks, config, seconds, no_frames)
    if pipeline.decisions.frames:
        yield certified(pipeline.decisions)


def _listen(
    port: Port, pipeline: Pipeline, configure: bool, seconds: float
) -> tuple[Chunks, str | None]:
    """Listen to the stream for so long, asking for it and decoding it as the driver does.

    configure: set the digitizer to these parameters; else it stays as it is. Returns what came,
    and why there are no frames in it.
    """
    config = pipeline.config
    # The amplitude is to be found, so the digitizer must not leave out what seems too weak by it.
    learning = replace(config, spec=replace(config.spec, amplitude_v=None))
    session = Session(learning if configure else None)
    chunks: Chunks = []
    size, opened_s, begin_s = 0, time.monotonic(), 0.0
    start_s = START_S + START_FRAMES * config.spec.frame_period_s
    port.write(session.open())
    try:
        while size < MOST_BYTES:
            data, t_host = port.read()
            if data:
                chunks.append((data, t_host))
                size += len(data)
            pipeline.feed(data, t_host)
            if not begin_s and pipeline.counters.frames:
                begin_s = t_host
                _log.debug("the first frame came after %.3f s", t_host - opened_s)
            if begin_s and t_host - begin_s > seconds:
                break
            told = session.problem and pipeline.problem
            if not begin_s and (told or t_host - opened_s > start_s):
                break
            if request := session.watch(pipeline, t_host):
                port.write(request)
    finally:
        port.write(session.close())
        told = pipeline.problem or port.problem or session.problem
    return chunks, None if begin_s else told
