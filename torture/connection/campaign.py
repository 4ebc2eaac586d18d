# SPDX-License-Identifier: Apache-2.0

"""Ports and digitizers that vanish, stall, are reset or replaced, and come back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from ..outcome import Outcome, Plan
from .interruptions import networked, reset, stalled, unplugged
from .plug import as_ordinary_user
from .trial import outcomes
from .wrong_port import forbidden, strange, unusable

KINDS = (stalled, reset, networked, unusable, strange)
"""Kinds of trials that run side by side, the longest first."""


def run(plan: Plan) -> Iterator[Outcome]:
    """Yield an outcome per kind of fault of a connection."""
    with TemporaryDirectory() as folder:
        yield unplugged(plan, Path(folder))
        yield from outcomes([trial for kind in KINDS for trial in kind(plan, Path(folder))])
    with TemporaryDirectory() as folder, as_ordinary_user(Path(folder)):
        yield from outcomes(forbidden(plan, Path(folder)))
