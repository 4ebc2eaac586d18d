# SPDX-License-Identifier: Apache-2.0

"""The dataclasses that pass from stage to stage, of which several are made for every frame."""

from dataclasses import dataclass
from typing import TypeVar, dataclass_transform

Class = TypeVar("Class")


@dataclass_transform(frozen_default=True)
def stage(cls: type[Class]) -> type[Class]:
    """Make a dataclass(frozen=True, slots=True), but frozen for mypy only.

    At run time that is a call of object.__setattr__ for every field, which takes five times as long
    as to set them: a third of all Python that a frame of 16 nodes needs.
    """
    return dataclass(slots=True)(cls)
