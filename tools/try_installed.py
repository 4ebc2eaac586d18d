# SPDX-License-Identifier: Apache-2.0

"""Uses the tactile_cdma that this Python has, as its users do; see tools/dist.py."""

import os
import subprocess
import sys
from pathlib import Path

from tactile_cdma import Skin

COMMANDS = ["doctor", "doctor sim:// --seconds 1"]
if os.name == "posix":  # Windows has no terminals that a program can make
    import pty

    COMMANDS += ["view sim:// --seconds 1"]


def main() -> None:
    """Decode a simulated skin, then run the commands; raises where something is wrong."""
    with Skin("sim://?scene=all&threshold=0", nodes=16) as skin:
        frames = [skin.read() for _ in range(10)]
    assert all(frame.active.all() and not frame.doubtful.any() for frame in frames)
    for words in COMMANDS:
        code, text = run("tactile-cdma", *words.split())
        assert code == 0 and "Traceback" not in text, f"{words}: exit code {code}\n{text}"


def run(program: str, *words: str) -> tuple[int, str]:
    """Run a program that is beside this Python; returns its exit code and what it showed."""
    command = [str(Path(sys.executable).parent / program), *words]
    environment = os.environ | {"TERM": "xterm", "LC_ALL": "C.UTF-8"}
    if os.name != "posix":
        done = subprocess.run(command, env=environment, capture_output=True)
        return done.returncode, (done.stdout + done.stderr).decode(errors="replace")
    terminal, its = pty.openpty()
    with subprocess.Popen(command, stdin=its, stdout=its, stderr=its, env=environment) as process:
        os.close(its)
        seen = bytearray()
        while data := read(terminal):
            seen += data
    os.close(terminal)
    return process.returncode, seen.decode(errors="replace")


def read(terminal: int) -> bytes:
    """Read what is shown; empty once the program has ended."""
    try:
        return os.read(terminal, 4096)
    except OSError:  # how Linux tells the end of a terminal
        return b""


if __name__ == "__main__":
    main()
