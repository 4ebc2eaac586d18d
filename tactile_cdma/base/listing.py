# SPDX-License-Identifier: Apache-2.0

"""Lists in messages: node numbers and the like, cut where a person stops reading."""

from collections.abc import Callable, Sequence
from typing import TypeVar

Item = TypeVar("Item")


def listed(
    items: Sequence[Item], noun: str = "", most: int = 20, show: Callable[[Item], str] = str
) -> str:
    """Items in a sentence: "3, 4, 9"; with the noun "node", "node 3" or "nodes 3, 4 and 12 more".

    most: items to show. show: returns the text of one.
    """
    text = ", ".join(map(show, items[:most]))
    if len(items) > most:
        text += f" and {len(items) - most} more"
    return f"{noun}{'s' * (len(items) != 1)} {text}" if noun else text
