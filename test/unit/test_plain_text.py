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

"""Text of strangers does nothing to a terminal, wherever an error quotes it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.errors import LayoutError, PortError, TactileError
from tactile_cdma.plain_text import MOST_SHOWN, plain
from tactile_cdma.source import SerialPort


@given(st.text())
def test_what_is_shown_can_be_printed_and_is_bounded(text: str) -> None:
    assert plain(text).isprintable()
    assert len(plain(text * 1000)) <= MOST_SHOWN
    if text.isprintable():
        assert plain(text) == text


def test_errors_escape_what_they_quote() -> None:
    for error in (TactileError, PortError, LayoutError):
        assert str(error("a\x1b[2Jb\n\u202ec µ…")) == r"a\x1b[2Jb\n\u202ec µ…"
    assert "\x1b" not in str(SerialPort("/dev/ttyACM0", "a \x1b]0;board", "1\x07"))
