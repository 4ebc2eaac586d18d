# SPDX-License-Identifier: Apache-2.0

"""Writes the list of the driver's parameters into docs/parameters.md; --check only compares."""

from __future__ import annotations

import sys
from pathlib import Path

from tactile_cdma.config.parameters import PARAMETERS, Parameter

PAGE = Path(__file__).resolve().parents[1] / "docs" / "parameters.md"
BEGIN, END = (
    "<!-- parameters: written by tools/parameter_table.py -->",
    "<!-- end of parameters -->",
)


def row(parameter: Parameter) -> str:
    default = str(parameter.default)
    if isinstance(parameter.default, bool):
        default = default.lower()
    elif isinstance(parameter.default, tuple):
        default = str(list(parameter.default))
    elif parameter.default == "":
        default = '""'
    allowed = ", ".join(f"`{choice}`" for choice in parameter.choices)
    if parameter.limits:
        low, high = parameter.limits
        allowed = f"{low:.10g}…{high:.10g} {parameter.unit}".strip()
    live = " •" if parameter.live else ""
    values = f"`{default}`" + (f"; {allowed}" if allowed else "")
    return f"- `{parameter.name}`{live} ({values}): {parameter.text}"


def with_table(text: str) -> str:
    """Return the page's text with the list replaced by the current one."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return "\n".join([before + BEGIN, *map(row, PARAMETERS), END + after])


def main() -> int:
    text = PAGE.read_text(encoding="utf-8")
    if "--check" in sys.argv:
        return int(with_table(text) != text)
    PAGE.write_text(with_table(text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
