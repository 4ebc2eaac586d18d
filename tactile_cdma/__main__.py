# SPDX-License-Identifier: Apache-2.0

"""Starts the command `tactile-cdma`: what loads for a second can be interrupted, or be missing."""

import signal
import sys

from .base.errors import KernelError
from .base.program import tell


def main() -> int:
    """Load the command and run it; returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the imports: no traceback
    try:
        from .commands.cli import main as run
    except ModuleNotFoundError as error:
        tell(f"{error}; python3 -m tactile_cdma.doctor tells all that is missing")
        return 1
    except KernelError as error:
        tell(error)
        return 1
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return run()


if __name__ == "__main__":
    sys.exit(main())
