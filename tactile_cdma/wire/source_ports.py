# SPDX-License-Identifier: Apache-2.0

"""Ports of sensors that send no chips: their schemes, built in or brought by other packages."""

from importlib.metadata import entry_points

SOURCES = "tactile_cdma.sources"
"""The package of sources, and the group of entry points that name those of other packages."""
BUILT_IN = ("text", "flexitac")
"""Schemes of the sources that come with this package."""


def scheme_of(url: str) -> str:
    """Return what stands before ://, in lower case; empty where nothing does."""
    scheme, mark, _ = url.partition("://")
    return scheme.lower() if mark else ""


def is_source(url: str) -> bool:
    """Tell whether a port's frames are those of a source."""
    scheme = scheme_of(url)
    return scheme in BUILT_IN or bool(scheme and entry_points(group=SOURCES, name=scheme))
