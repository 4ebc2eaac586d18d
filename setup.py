# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel, which pyproject.toml cannot declare; all else is declared there.

Sources and options are those of CMakeLists.txt. Without a C compiler the package is installed
without the kernel, and numpy does its work.
"""

from pathlib import Path

from setuptools import Extension, setup

kernel = Extension(
    "tactile_cdma._kernel",
    sources=sorted(map(str, Path("kernel").glob("*.c"))),
    depends=[
        *sorted(map(str, Path("kernel").glob("*.h"))),
        "kernel/options.txt",
        "firmware/core/tactile_protocol.h",
    ],
    extra_compile_args=Path("kernel/options.txt").read_text().split(),
    libraries=["m"],
    py_limited_api=True,
    optional=True,
)
setup(ext_modules=[kernel], options={"bdist_wheel": {"py_limited_api": "cp311"}})
