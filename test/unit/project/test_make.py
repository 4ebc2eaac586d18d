# SPDX-License-Identifier: Apache-2.0

"""The Makefile refuses variables that it does not know; make itself would ignore them."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from test.support.programs import run_program

ROOT = Path(__file__).resolve().parents[3]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
[KNOWN] = re.findall(r"^VARIABLES = (.*)$", MAKEFILE, re.MULTILINE)

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def make(*words: str) -> subprocess.CompletedProcess[str]:
    # Without the variables of a `make test` that runs this.
    environment = {name: text for name, text in os.environ.items() if "MAKE" not in name}
    return run_program("make", *words, cwd=ROOT, env=environment)


@pytest.mark.parametrize(
    ("variable", "said"),
    [
        ("port=/dev/ttyACM0", "no variable port; did you mean PORT? (there are "),
        ("PRAMS=a.yaml", "no variable PRAMS; did you mean PARAMS? (there are "),
        ("TTY=/dev/ttyACM0", "no variable TTY (there are "),
    ],
)
def test_an_unknown_variable_ends_make_and_names_what_was_meant(variable: str, said: str) -> None:
    for target in ("run", "view", "help", "bench-error"):
        done = make(target, variable)
        assert done.returncode == 2
        assert said in done.stderr
        assert done.stdout == ""


def test_all_documented_variables_are_taken() -> None:
    described = {*re.findall(r"\b([A-Z]{3,})=", MAKEFILE.partition("\n\n")[0])}
    assert {"PORT", "PARAMS", "QUICK", "DISTRO"} <= described
    assert described <= set(KNOWN.split())
    given = [f"{name}=1" for name in KNOWN.split() if name not in ("LC_ALL", "PYTHON")]
    assert make("help", *given, "-j2").returncode == 0
