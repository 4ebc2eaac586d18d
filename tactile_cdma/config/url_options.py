# SPDX-License-Identifier: Apache-2.0

"""Options of a port's URL, ?name=value&name=value, read against a table of parameters."""

import reprlib
from collections.abc import Iterable
from typing import Any
from urllib.parse import parse_qsl

from ..base.errors import ParameterError, SpecError
from ..base.text import suggestion
from .parameters import NATURAL_SIGNS, TRUTH, Parameter, Value

_TRUTH = TRUTH | {"1": True, "0": False}


def parse_options(query: str, options: Iterable[Parameter], scheme: str) -> dict[str, Any]:
    """Read the options that a query gives, each in its parameter's type.

    Raises SpecError for an option that is unknown, given twice or of a wrong value.
    """
    known, values = {option.name: option for option in options}, dict[str, Any]()
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in known:
            hint = suggestion(name, known, f"options: {', '.join(known)}")
            raise SpecError(f"{scheme} has no option {name!r}{hint}")
        if name in values:
            raise SpecError(f"option {name!r} is given twice")
        values[name] = check_option(known[name], _typed(known[name], text))
    return values


def check_option(option: Parameter, value: Value) -> Value:
    """Check an option's value. Raises SpecError, naming value, limits and near choices."""
    try:
        return option.check(value)
    except ParameterError as error:
        hint = suggestion(str(value), map(str, option.choices))
        raise SpecError(f"option {error}{hint}") from None


def _typed(option: Parameter, text: str) -> Value:
    if option.name == "sign_seed" and text == "natural":
        return NATURAL_SIGNS
    kind: Any = type(option.default)
    try:
        if option.pair and "," in text:
            return tuple(map(float, text.strip("[]").split(",")))
        value: Value = _TRUTH[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        wanted = {bool: "true or false (0 or 1)", int: "an integer", float: "a number"}[kind]
        raise SpecError(
            f"option {option.name} is {reprlib.repr(text)}; it must be {wanted}"
        ) from None
    return value
