# SPDX-License-Identifier: Apache-2.0

"""Files that come with the package but lie outside it: configuration, examples, messages."""

import os
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
"""Folder of the package; only in a checkout the files lie there as well."""


def shipped(name: str) -> Path | None:
    """Find a file in the checkout, a workspace's share folder, or a wheel; None: not installed."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders = [Path(prefix) / "share" / "tactile_cdma" for prefix in prefixes if prefix]
    if (CHECKOUT / "package.xml").is_file():
        folders.insert(0, CHECKOUT)
    folders.append(CHECKOUT / "tactile_cdma" / "share")  # setup.py copies them there
    return next((folder / name for folder in folders if (folder / name).is_file()), None)
