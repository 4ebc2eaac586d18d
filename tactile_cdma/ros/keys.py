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

"""Keys pressed in a terminal, without waiting for them or for Enter."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from types import TracebackType


class Keys:
    """While in its context, stdin, a terminal, gives keys at once and does not echo them."""

    def __enter__(self) -> Keys:
        self._stdin = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._stdin)
        tty.setcbreak(self._stdin)  # Ctrl-C still interrupts
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        termios.tcsetattr(self._stdin, termios.TCSADRAIN, self._before)

    def read(self) -> str:
        """What was pressed since the last call."""
        if not select.select([self._stdin], [], [], 0)[0]:
            return ""
        return os.read(self._stdin, 64).decode("ascii", errors="ignore")
