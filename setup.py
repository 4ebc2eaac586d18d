# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel, which pyproject.toml cannot declare; all else is declared there.

Its sources and options are those of CMakeLists.txt; kernel/build_kernel.py binds it.
"""

from setuptools import setup

setup(
    cffi_modules=["kernel/build_kernel.py:builder"],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
