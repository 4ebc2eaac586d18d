# SPDX-License-Identifier: Apache-2.0

"""Text of strangers does nothing to a terminal, wherever an error quotes it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import LayoutError, PortError, TactileError
from tactile_cdma.base.plain_text import MOST_SHOWN, plain
from tactile_cdma.wire.discovery import SerialPort


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
