# SPDX-License-Identifier: Apache-2.0

"""Takes from a process what Python lacks on Windows: `pytest -p test.support.windows`.

What needs it at import, or in a test, fails then. pyserial and the standard library, which are
others on Windows, are loaded before. The last line of the run counts: `make portable-test`.
"""

import os
import select
import signal
import sys
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import pytest

MODULES = "fcntl", "termios", "pty", "resource"
ALSO = "tty", "grp", "pwd", "syslog"
"""Lacking, too; MODULES are those that programs use most."""
NAMES = {
    os: (
        *("O_DIRECTORY", "O_NOCTTY", "O_NONBLOCK", "fchmod", "getegid", "geteuid"),
        *("getgroups", "major", "minor", "openpty", "register_at_fork", "ttyname"),
    ),
    select: ("poll", "epoll"),
    signal: ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGWINCH"),
}
"""Names that these modules lack there, but for those that pytest needs on this system."""
LOADED = (
    *("asyncio", "concurrent.futures", "getpass", "logging.handlers", "mailbox", "multiprocessing"),
    *("pathlib", "shutil", "subprocess", "tarfile", "tempfile", "xdist.workermanage", "serial"),
    *("serial.tools.list_ports", "serial.urlhandler.protocol_socket", "multiprocessing.context"),
)
"""Loaded before, as they choose by the system what they need."""


def _block() -> None:
    for name in LOADED:
        import_module(name)
    pyserial: Any = sys.modules["serial.serialposix"]
    pyserial.os = SimpleNamespace(**vars(os))  # so that it opens what is no port, as on Windows
    for name in (*MODULES, *ALSO):
        sys.modules[name] = None  # type: ignore[assignment]
    for module, names in NAMES.items():
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
    ours = [name for name in sys.modules if name.partition(".")[0] == "tactile_cdma"]
    assert not ours, "loaded before they were blocked"


_block()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    count = {kind: len(terminalreporter.getreports(kind)) for kind in ("passed", "skipped")}
    bad = len(terminalreporter.getreports("failed")) + len(terminalreporter.getreports("error"))
    terminalreporter.write_line(
        f"blocked={','.join(MODULES)} tests={count['passed'] + bad} skipped={count['skipped']} "
        f"failed={bad}"
    )
