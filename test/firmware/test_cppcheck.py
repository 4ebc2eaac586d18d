"""cppcheck finds nothing in the firmware."""

from __future__ import annotations

from conftest import FIRMWARE, need, run


def test_cppcheck_is_content() -> None:
    checks = ("--enable=warning,performance,portability", "--error-exitcode=1", "--inline-suppr")
    ignored = ("--suppress=missingIncludeSystem", "-i", FIRMWARE / "build")
    includes = ("-I", FIRMWARE / "core")
    command = need("cppcheck")
    run(command, "--quiet", "--std=c11", *checks, *ignored, *includes, FIRMWARE)
