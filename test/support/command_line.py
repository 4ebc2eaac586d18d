# SPDX-License-Identifier: Apache-2.0

"""The command line, given words that it has to refuse."""

from collections.abc import Callable
from typing import TypeAlias

import pytest

from tactile_cdma.commands.cli import main

Refused: TypeAlias = Callable[..., str]
"""What `refused` is: gives words to `tactile-cdma`, and returns the one line with which it ends."""


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
