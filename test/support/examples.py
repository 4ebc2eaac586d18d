# SPDX-License-Identifier: Apache-2.0

"""How many examples of a law are tried: all of them by `make test`, a share by `make check`."""

from hypothesis import settings

USUAL = 100
"""Examples of a law that names no number, in `make test`."""


def examples(count: int) -> settings:
    """So many, and of a profile with fewer than USUAL in that proportion: a decorator."""
    return settings(max_examples=max(1, count * settings.default.max_examples // USUAL))
