# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Ports and digitizers that go away, stall, are reset or are others, and come back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from ..outcome import Outcome, Plan
from .network import networked
from .plug import as_ordinary_user
from .stalling import stalled
from .trial import outcomes
from .unplugging import reset, unplugged
from .wrong_port import forbidden, strange, unusable

KINDS = (stalled, reset, networked, unusable, strange)
"""What runs side by side, the longest first."""


def run(plan: Plan) -> Iterator[Outcome]:
    """Everything that a connection may suffer."""
    with TemporaryDirectory() as folder:
        yield unplugged(plan, Path(folder))
        yield from outcomes([trial for kind in KINDS for trial in kind(plan, Path(folder))])
    with TemporaryDirectory() as folder, as_ordinary_user(Path(folder)):
        yield from outcomes(forbidden(plan, Path(folder)))
