# SPDX-License-Identifier: Apache-2.0

"""Options of a port's URL, ?name=value&name=value, read against a table of parameters."""

from collections.abc import Callable, Iterable
from typing import Any
from urllib.parse import parse_qsl

from ..base.errors import ParameterError, SpecError
from ..base.suggest import suggestion
from .parameters import NATURAL_SIGNS, Parameter, Value, of_text

_TRUTH = {"0": "false", "1": "true"}
_WORDS = {"sign_seed": {"natural": str(NATURAL_SIGNS)}}
"""Other words for values, of all that are true or false, and by option."""


def parse_options(query: str, options: Iterable[Parameter], scheme: str) -> dict[str, Any]:
    """The options that a query gives, each in its parameter's type.

    Raises SpecError for an option that is unknown, given twice or of a wrong value.
    """
    known, values = {option.name: option for option in options}, dict[str, Any]()
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in known:
            hint = suggestion(name, known, f"options: {', '.join(known)}")
            raise SpecError(f"{scheme} has no option {name!r}{hint}")
        if name in values:
            raise SpecError(f"option {name!r} is given twice")
        words = _TRUTH if isinstance(known[name].default, bool) else _WORDS.get(name, {})
        values[name] = check_option(known[name], words.get(text, text), of_text)
    return values


def check_option(
    option: Parameter, value: Any, read: Callable[[Parameter, Any], Value] = Parameter.check
) -> Value:
    """The value in the option's type. Raises SpecError, naming value, limits and near choices."""
    try:
        return read(option, value)
    except ParameterError as error:
        hint = suggestion(str(value), map(str, option.choices))
        raise SpecError(f"option {error}{hint}") from None
