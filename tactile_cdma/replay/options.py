# SPDX-License-Identifier: Apache-2.0

"""The options of a replay:// URL."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from ..base.errors import SpecError
from ..config.parameters import REPLAY, Parameter
from ..config.skin_config import user_path
from ..config.url_options import parse_options

_LONGEST_S = 1e9
"""Longer than any recording."""
OPTIONS: tuple[Parameter, ...] = (
    Parameter(
        "speed", 1.0, "pace; 1: as it was recorded, 0: as fast as it is read", "", (0.0, 1000.0)
    ),
    Parameter("loop", False, "begin again at the end"),
    Parameter("start", 0.0, "skip what was recorded before", "s", (0.0, _LONGEST_S)),
    Parameter("end", _LONGEST_S, "skip what was recorded after", "s", (0.0, _LONGEST_S)),
)
SLOWEST = 0.1
"""Least speed above 0: a driver takes a slower port for dead."""


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """What to replay and how. start_s, end_s: times since the recording began, s."""

    path: Path
    speed: float
    loop: bool
    start_s: float
    end_s: float

    @classmethod
    def from_url(cls, url: str) -> ReplayOptions:
        """From replay://FILE?option=value&…; raises SpecError."""
        file, _, query = url[len(REPLAY) :].partition("?")
        if not file:
            raise SpecError("name the recording: replay://FILE, for example replay://touch.skin")
        defaults: dict[str, Any] = {option.name: option.default for option in OPTIONS}
        values = defaults | parse_options(query, OPTIONS, "replay://")
        speed, start_s, end_s = values["speed"], values["start"], values["end"]
        if 0 < speed < SLOWEST:
            raise SpecError(f"option speed is {speed:g}; it must be 0 or at least {SLOWEST:g}")
        if start_s >= end_s:
            raise SpecError(f"option start is {start_s:g} s, which is not before end, {end_s:g} s")
        path = user_path("the recording", unquote(file))
        return cls(path, speed, values["loop"], start_s, end_s)
