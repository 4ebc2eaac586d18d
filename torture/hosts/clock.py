# SPDX-License-Identifier: Apache-2.0

"""Wall clocks that are off, for the processes of a host."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).with_name("clock_offset.c")


class WrongClock:
    """This computer's wall clock plus an offset, which is 0 at first.

    environment: of the processes that have it.
    """

    def __init__(self, folder: Path, name: str) -> None:
        """Raises CalledProcessError or OSError without a C compiler. name: of its file."""
        library = folder / "clock_offset.so"
        if not library.exists():
            command = ["cc", "-O2", "-shared", "-fPIC", "-o", str(library), str(SOURCE)]
            subprocess.run(command, check=True)
        self._path = folder / f"clock_{name}"
        self._path.write_bytes(bytes(8))
        self.environment = {"LD_PRELOAD": str(library), "CLOCK_OFFSET_FILE": str(self._path)}

    def set(self, offset_s: float) -> None:
        """Change the offset, at once for all its processes."""
        with self._path.open("r+b") as file:  # they have mapped it: not a new file
            file.write(round(offset_s * 1e9).to_bytes(8, sys.byteorder, signed=True))
