# SPDX-License-Identifier: Apache-2.0

"""The command line, given words that it has to do or to refuse."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import pytest

from tactile_cdma.commands.cli import main


class Said(NamedTuple):
    """What a command has written."""

    out: str
    err: str


Done: TypeAlias = Callable[..., Said]
"""What `done` is: gives words to `tactile-cdma`, which ends with exit_code, by default 0."""
Refused: TypeAlias = Callable[..., str]
"""What `refused` is: gives words to `tactile-cdma`, and returns the one line with which it ends."""


@pytest.fixture
def done(capsys: pytest.CaptureFixture[str]) -> Done:
    def said_of(*words: object, exit_code: int = 0) -> Said:
        capsys.readouterr()
        assert main([*map(str, words)]) == exit_code
        return Said(*capsys.readouterr())

    return said_of


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    def said_of(*words: object) -> str:
        capsys.readouterr()
        assert main([*map(str, words)]) == 1
        out, err = capsys.readouterr()
        assert (out, len(err.splitlines())) == ("", 1), err
        assert err.startswith("tactile-cdma: ")
        return err

    return said_of
