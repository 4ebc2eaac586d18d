# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma examples`: copies the files that documents name into a folder."""

import argparse
import shutil
from pathlib import Path

from ..base.errors import ParameterError
from ..base.named_file import naming, shipped

COPIED = "config/skin.yaml", "examples/mujoco_skin.py", "urdf/skin.urdf.xacro"
"""Files in the folders that are copied."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="where they go (here)")


def run(arguments: argparse.Namespace) -> int:
    """Copy all folders that are not there yet; returns the exit code."""
    for source in map(shipped, COPIED):
        if source is None:
            raise ParameterError("examples are not installed: pip install tactile_cdma")
        target = arguments.folder / source.parent.name
        with naming(target, ParameterError):
            shutil.copytree(source.parent, target, ignore=shutil.ignore_patterns("__pycache__"))
        print(target)
    return 0
