# SPDX-License-Identifier: Apache-2.0

"""Messages and requests that are valid by their type, and lie in their fields."""

from __future__ import annotations

import copy
import math
import re
import time
from array import array
from importlib import import_module
from random import Random
from typing import Any

_REALS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-30, -3e38, 3e38)
_TEXTS = (
    "",
    "\x1b[2J\x1b]0;owned\x07",
    "\u202e/skin",
    "a" * 10_000,
    "/",
    "skin: stream",
    "no\nline",
    "map",
)
_LENGTHS = (0, 1, 2, 15, 17, 300, 20_000)
_CODES = {"float": "f", "double": "d"} | {
    f"{sign}int{bits}": code.upper() if sign else code
    for bits, code in ((8, "b"), (16, "h"), (32, "i"), (64, "q"))
    for sign in ("", "u")
}


def lie(message: Any, rng: Random) -> Any:
    """A copy of a message of which some fields, on any level, are other ones."""
    lying = copy.deepcopy(message)
    kinds = list(lying.get_fields_and_field_types().items())
    for name, kind in rng.sample(kinds, min(len(kinds), rng.choice((1, 1, 2, len(kinds))))):
        setattr(lying, name, _changed(getattr(lying, name), kind, rng))
    return lying


def of_now(message: Any) -> Any:
    """Give a skin's frame the present time and a number, without which nobody looks at it."""
    if hasattr(message, "sequence"):
        now_ns = time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
        message.sequence = now_ns
    return message


def _changed(value: Any, kind: str, rng: Random) -> Any:
    """Another value of a field. kind: as in get_fields_and_field_types."""
    if hasattr(value, "get_fields_and_field_types"):
        return lie(value, rng)
    sequence = re.fullmatch(r"sequence<([^,>]+)(?:, (\d+))?>", kind)
    if sequence is None:
        return _scalar(kind, rng) if not kind.endswith("]") else value
    element, most = sequence[1], int(sequence[2] or _LENGTHS[-1])
    kept = list(value)[: rng.choice((0, 1, len(value) // 2, len(value) - 1, len(value)))]
    if kept and rng.random() < 0.5:
        at = rng.randrange(len(kept))
        kept[at] = _changed(kept[at], element, rng)
    elif rng.random() < 0.5:
        length = rng.choice(_LENGTHS if element in _CODES else _LENGTHS[:-2])
        kept += [_scalar(element, rng)] * length
    kept = kept[:most]
    return array(_CODES[element], kept) if element in _CODES else kept


def _scalar(kind: str, rng: Random) -> Any:
    if number := re.fullmatch(r"(u?)int(\d+)", kind):
        bits = int(number[2]) - (not number[1])
        least = 0 if number[1] else -(1 << bits)
        return rng.choice((least, 0, 1, rng.randint(0, 20), (1 << bits) - 1))
    if kind in ("float", "double"):
        return rng.choice(_REALS)
    if kind == "boolean":
        return rng.random() < 0.5
    if kind == "octet":
        return bytes([rng.randrange(256)])
    if kind == "string":
        return rng.choice(_TEXTS)
    package, name = kind.split("/")
    return lie(getattr(import_module(f"{package}.msg"), name)(), rng)
