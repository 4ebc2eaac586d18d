# SPDX-License-Identifier: Apache-2.0

"""Who measures: a digitizer, by the 8 bytes of its id, or a source without chips, by its URL."""

import re
from importlib.metadata import entry_points

from ..base.errors import ParameterError
from ._protocol import DEMO_WIRED, DEMO_WIRELESS, SIMULATED_ID

ID_BYTES = 8
NO_ID = bytes(ID_BYTES)
"""Reported by a board that has no number of its own."""
SOURCE_ID = b"src\0"
"""Begins the ids of sources, which send no chips: every packet of samples is a frame of codes."""
NO_READING = -1
"""Count of a source's taxel that has no reading."""
UNSCALED = 1.0
"""volts_per_count of a source whose values are codes."""
SOURCES = "tactile_cdma.sources"
"""The package of sources, and the group of entry points that name those of other packages."""
BUILT_IN = ("text", "flexitac")
"""Schemes of the sources that come with this package."""
_DEMONSTRATORS = {
    DEMO_WIRED.to_bytes(2, "little"): "a demonstrator without sensors, its pins wired",
    DEMO_WIRELESS.to_bytes(2, "little"): "a demonstrator without sensors, nothing wired",
}
"""Kinds of demonstrators by the end of their ids; no seed of a simulator, below 2³¹, ends so."""
_SEPARATORS = re.compile(r"[\s:._-]")


def parse_id(text: str) -> bytes:
    """Return the 8 bytes of an id in hexadecimal digits; 0x and separators are allowed.

    Raises ParameterError for anything else, and for all zeros, which mean that there is no id.
    """
    digits = _SEPARATORS.sub("", text).lower().removeprefix("0x")
    if not re.fullmatch(f"[0-9a-f]{{{2 * ID_BYTES}}}", digits):
        raise ParameterError(
            f"digitizer_id is {text!r}; it must be {2 * ID_BYTES} hexadecimal digits, as "
            "tactile-cdma ports shows them"
        )
    digitizer_id = bytes.fromhex(digits)
    if digitizer_id == NO_ID:
        raise ParameterError(
            f"digitizer_id is {text!r}; zeros are what boards without an id report: leave it empty"
        )
    return digitizer_id


def shown_id(digitizer_id: bytes) -> str:
    """Return an id for people, as in the USB serial number of the RP2040's firmware."""
    return "no id" if digitizer_id == NO_ID else digitizer_id.hex().upper()


def is_simulated(digitizer_id: bytes) -> bool:
    """Tell whether a digitizer says by its id that nothing is measured: nobody touches a sensor."""
    return digitizer_id.startswith(SIMULATED_ID)


def is_demonstrator(digitizer_id: bytes) -> bool:
    """Tell whether a digitizer says it is a demonstrator: a board whose nodes have no sensors."""
    return is_simulated(digitizer_id) and digitizer_id[6:] in _DEMONSTRATORS


def is_source_id(digitizer_id: bytes) -> bool:
    """Tell whether a digitizer's samples are the codes of a source."""
    return digitizer_id.startswith(SOURCE_ID)


def kind_of(digitizer_id: bytes) -> str:
    """Tell what a digitizer is, for people; empty for a board."""
    if is_demonstrator(digitizer_id):
        return _DEMONSTRATORS[digitizer_id[6:]]
    if is_source_id(digitizer_id):
        return "a source without chips"
    return "simulated" if is_simulated(digitizer_id) else ""


def scheme_of(url: str) -> str:
    """Return what stands before ://, in lower case; empty where nothing does."""
    scheme, mark, _ = url.partition("://")
    return scheme.lower() if mark else ""


def is_source(url: str) -> bool:
    """Tell whether a port's frames are those of a source."""
    scheme = scheme_of(url)
    return scheme in BUILT_IN or bool(scheme and entry_points(group=SOURCES, name=scheme))
