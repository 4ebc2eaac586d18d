# SPDX-License-Identifier: Apache-2.0

"""Whether a digitizer is on a port, the right one, and what its skin says."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..base.errors import PortError, TactileError
from ..config.parameters import BY_NAME, Value, read_file
from ..config.skin_config import SkinConfig
from ..driver.pipeline import Pipeline
from ..driver.session import Session
from ..recording.offline import parameters_of
from ..wire.discovery import leave_alone_if_open
from ..wire.introduction import described_info, introduction
from ..wire.port import Port
from .report import Check, ok, problem
from .stream import Stream, judge

START_S = 3.5
"""A digitizer gets so long, and some frames, to send a first one: it is asked several times."""
START_FRAMES = 4
MOST_BYTES = 64 << 20


@dataclass(frozen=True, slots=True)
class Patient:
    """What is to be examined. values: of a parameter file, None without one."""

    url: str
    baud: int
    values: dict[str, Value] | None


def examine(
    url: str | None, params: Path | None, baud: int | None, seconds: float
) -> Iterator[Check]:
    """All that there is to say of a port, or of the one that a parameter file names."""
    try:
        patient = _patient(url, params, baud)
        if params is not None and patient.values is not None:
            SkinConfig.of(patient.values)
            yield ok("parameters", f"{params}")
    except TactileError as error:
        yield problem("parameters", str(error))
        return
    try:
        leave_alone_if_open(patient.url)
        with Port(patient.url, patient.baud) as port:
            yield ok("port", f"{patient.url} opened")
            yield from _examine(port, patient, seconds)
    except PortError as error:
        yield problem("port", str(error))
    except TactileError as error:
        yield problem("digitizer", str(error))


def _patient(url: str | None, params: Path | None, baud: int | None) -> Patient:
    values = read_file(params) if params is not None else None
    get: dict[str, Any] = {name: parameter.default for name, parameter in BY_NAME.items()} | (
        values or {}
    )
    return Patient(url or str(get["port"]), baud or int(get["baud"]), values)


def _examine(port: Port, patient: Patient, seconds: float) -> Iterator[Check]:
    info = introduction(port)
    if patient.values is None:
        config = SkinConfig.of({**parameters_of(info), "amplitude_mv": 0.0})
    else:
        config = SkinConfig.of(patient.values)
    if wrong := config.refusal(info.digitizer_id):
        yield problem("digitizer", wrong)
        return
    yield ok("digitizer", described_info(info))
    yield from judge(_listen(port, config, patient.values is not None, seconds), config)


def _listen(port: Port, config: SkinConfig, configure: bool, seconds: float) -> Stream:
    """The stream of so many seconds, asked for as the driver does.

    configure: set the digitizer to these parameters; else it stays as it is.
    """
    # The amplitude is to be found, so the digitizer must not leave out what seems too weak by it.
    learning = replace(config, spec=replace(config.spec, amplitude_v=None))
    session, pipeline = Session(learning if configure else None), Pipeline(config)
    chunks: list[tuple[bytes, float]] = []
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
            if begin_s and t_host - begin_s > seconds:
                break
            told = session.problem and pipeline.problem
            if not begin_s and (told or t_host - opened_s > start_s):
                break
            if request := session.watch(pipeline, t_host):
                port.write(request)
    finally:
        pipeline.close()
        port.write(session.close())
    return Stream(chunks, pipeline.problem or session.problem if not begin_s else None)
