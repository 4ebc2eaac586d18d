# SPDX-License-Identifier: Apache-2.0

"""The command line, given words: what it prints of them, or how it refuses them."""

from collections.abc import Callable
from typing import Any, TypeAlias

import pytest

from tactile_cdma.commands.cli import main

Printed: TypeAlias = Callable[..., Any]
"""What `printed` is: gives words to `tactile-cdma`, which ends with code=0; returns out and err."""
Refused: TypeAlias = Callable[..., str]
"""What `refused` is: gives words to `tactile-cdma`, and returns the one line with which it ends."""


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    def said_of(*words: object, code: int = 0) -> Any:
        capsys.readouterr()
        assert main([*map(str, words)]) == code
        return capsys.readouterr()

    return said_of


@pytest.fixture
def refused(printed: Printed) -> Refused:
    def said_of(*words: object) -> str:
        out, err = printed(*words, code=1)
        assert (out, len(err.splitlines())) == ("", 1), err
        assert err.startswith("tactile-cdma: ")
        return err

    return said_of
