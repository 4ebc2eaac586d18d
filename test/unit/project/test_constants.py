# SPDX-License-Identifier: Apache-2.0

"""The numbers by which frames and words are judged: found, replaced, and not too many."""

import pytest

from tools.constants import MOST, MOST_CHOSEN, constants, heart, replaced

SOURCE = '''
from dataclasses import dataclass
LEFT = 0.5
"""Chosen."""
WIDE, NARROW = 1 << 3, -2.0
"""Derived."""
TAPS: tuple[int, ...] = (1, (2, 3))
"""Chosen: by trying."""
REACHES = np.array([0.5, 0.25])
TWICE = 2 * LEFT
SHOWN = "1"
IS_ON = True
small = 7

@dataclass(frozen=True)
class Limits:
    """What a frame must be.

    loud: deviations.
    few, many: words. Chosen:
        a few.
    """

    loud: float = 2.0
    few: int = 3
    many: int = 4
    name: str = "a"
    late: float = 0.1
    """Chips. Chosen."""

class Frame:
    chips: int = 9
'''


def test_constants_are_numbers_with_a_name_in_capitals_and_fields_of_limits() -> None:
    found = {one.name: (one.value, one.is_chosen) for one in constants("a.b", SOURCE)}
    assert found == {
        "LEFT": (0.5, True),
        "WIDE": (8, False),
        "NARROW": (-2.0, False),
        "TAPS[0]": (1, True),
        "TAPS[1][0]": (2, True),
        "TAPS[1][1]": (3, True),
        "REACHES[0]": (0.5, False),
        "REACHES[1]": (0.25, False),
        "Limits.loud": (2.0, False),
        "Limits.few": (3, True),
        "Limits.many": (4, True),
        "Limits.late": (0.1, True),
    }


def test_what_is_made_of_a_constant_follows_another_value_of_it() -> None:
    source = SOURCE.replace("np.array", "list")
    space: dict[str, object] = {}
    values = {"LEFT": 3.0, "NARROW": 5.0, "TAPS[1][0]": 8, "REACHES[1]": 1.0, "Limits.few": 6}
    exec(compile(replaced(source, values), "source", "exec"), space)
    assert (space["LEFT"], space["TWICE"]) == (3.0, 6.0)
    assert (space["WIDE"], space["NARROW"]) == (8, 5.0)
    assert (space["TAPS"], space["REACHES"]) == ((1, (8, 3)), [0.5, 1.0])
    limits = space["Limits"]()  # type: ignore[operator]
    assert (limits.loud, limits.few, limits.many) == (2.0, 6, 4)
    with pytest.raises(KeyError, match="TWICE"):
        replaced(source, {"TWICE": 1.0})


def test_the_heart_has_no_more_constants_than_its_goal() -> None:
    found = heart()
    assert len(found) <= MOST
    assert sum(one.is_chosen for one in found) <= MOST_CHOSEN
    assert len({(one.module, one.name) for one in found}) == len(found) > 50
