# SPDX-License-Identifier: Apache-2.0

"""Programs as users that are not root."""

import os
import shutil

import pytest

USER = 65_534
"""Number of "nobody" on Linux."""
NAMELESS = 54_777
"""Number of a user whom no file knows."""


def ordinary(group: int, user: int = USER) -> list[str]:
    """What makes a command an ordinary user's: nothing, unless root runs the tests.

    It may read everything, for the interpreter may be in a folder of root's; write, own or open
    anything that others may not, it cannot.
    """
    if os.getuid():
        return []
    if not shutil.which("setpriv"):
        pytest.skip("setpriv (Debian: util-linux) is not installed")
    kept = [f"--{which}=-all,+dac_read_search" for which in ("inh-caps", "ambient-caps")]
    return [
        *("setpriv", f"--reuid={user}", f"--regid={user}", f"--groups={group}"),
        *(*kept, "--bounding-set=-all,+dac_read_search", "--no-new-privs"),
    ]
