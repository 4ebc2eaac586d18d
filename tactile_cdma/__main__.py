# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Starts the command `tactile-cdma`: what loads for a second can be interrupted, or be missing."""

from __future__ import annotations

import signal
import sys


def main() -> int:
    """Load the command and run it; returns the exit code."""
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback of imports
    try:
        from .cli import main as run
    except ModuleNotFoundError as error:
        print(
            f"tactile-cdma: {error}; python3 -m tactile_cdma.doctor tells all that is missing",
            file=sys.stderr,
        )
        return 1
    signal.signal(signal.SIGINT, handler)
    return run()


if __name__ == "__main__":
    sys.exit(main())
