# SPDX-License-Identifier: Apache-2.0

"""The core's tests again, under the compiler's sanitizers."""

import os
from pathlib import Path

import pytest

from test.support.firmware import SANITIZED, need, run
from test.support.programs import run_python

HERE = Path(__file__).parent
TESTS = [*HERE.glob("test_core_[!r]*.py"), HERE / "test_node_core.py"]
"""Those that call the core as a library: all but the replay."""


@pytest.mark.slow
def test_the_core_stays_within_its_memory_and_its_numbers() -> None:
    library = run(need("cc"), "-print-file-name=libasan.so").strip()
    if not Path(library).is_absolute():
        pytest.skip("this compiler has no libasan.so: the core is not tested with sanitizers")
    # Python itself leaks, and its allocator is none of ours.
    watched = {"LD_PRELOAD": library, "ASAN_OPTIONS": "detect_leaks=0", SANITIZED: "1"}
    # Not captured: what a sanitizer says would be lost with the process that it ends.
    quietly = ("-q", "-x", "-s", "-p", "no:cacheprovider", "--hypothesis-profile", "quick")
    command = ("-m", "pytest", *quietly, *TESTS)
    result = run_python(*command, env={**os.environ, **watched}, timeout=600)
    assert result.returncode == 0, result.stdout[-5000:] + result.stderr[-5000:]
