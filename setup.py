# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel, and files beside the package; all else is declared in pyproject.toml.

The kernel's sources and options are those of CMakeLists.txt; kernel/build_kernel.py binds it.
"""

import shutil
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SHARED = "config", "examples", "msg", "urdf"
"""Folders in a colcon workspace's share folder, where base/named_file.py finds them."""


class BuildWithFiles(build_py):
    """Copies them into the package that is built."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:  # they are found in the checkout
            ignored = shutil.ignore_patterns("__pycache__")
            for name in SHARED:
                target = Path(self.build_lib, "tactile_cdma", "share", name)
                shutil.copytree(name, target, ignore=ignored, dirs_exist_ok=True)


# The kernel needs vectors as GCC and clang have them, which Microsoft's compiler has not.
compiler = {"build": {"compiler": "mingw32"}} if sys.platform == "win32" else {}
setup(
    cmdclass={"build_py": BuildWithFiles},
    cffi_modules=["kernel/build_kernel.py:builder"],
    options={"bdist_wheel": {"py_limited_api": "cp311"}, **compiler},
)
