# SPDX-License-Identifier: Apache-2.0

"""Body files: YAML → the patches of one body, each with the parameters of its driver.

docs/patches.md describes the format.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.errors import BodyError, ParameterError
from ..base.marked_yaml import Mapping as Keys
from ..base.marked_yaml import Marked, read_marked
from ..base.named_file import expanded
from ..wire.identity import parse_id, shown_id
from .parameters import BY_NAME, REPLAY, SIMULATION, Parameter, Value, read_file, unknown

NODE_NAME = "skin"
"""Of a driver, unless it is renamed; those of a body are in namespaces of the patches' names."""
MOST_PATCHES = 1000
SHARED_PORTS = (SIMULATION, REPLAY)
"""Beginnings of ports that any number of drivers can open."""
_NAME = re.compile("[A-Za-z][A-Za-z0-9_]*")
_KEYS = ("frame_id", "patches")
_PATCH_KEYS = ("params_file", "parameters")
_FILES = ("layout_file", "calibration_file", "state_folder")
"""Parameters that are paths: here they begin in the body file's folder."""
_MOUNTS = ("mount_xyz_m", "mount_rpy_rad")


@dataclass(frozen=True, slots=True)
class Patch:
    """One driver.

    params_file: its ROS 2 parameter file, None: none. parameters: what goes before that file,
    frame_id always among them.
    """

    name: str
    params_file: Path | None
    parameters: Mapping[str, Value]

    @property
    def node(self) -> str:
        """Fully qualified name of the driver's node."""
        return f"/{self.name}/{NODE_NAME}"


@dataclass(frozen=True, slots=True)
class Body:
    """The patches of a body, in the order of the file. frame_id: tf frame of the whole."""

    frame_id: str
    patches: tuple[Patch, ...]

    def only(self, names: str) -> tuple[Patch, ...]:
        """The patches of these names, with commas between them; all for an empty text.

        Raises BodyError for a name that no patch has.
        """
        wanted = [name.strip() for name in names.split(",") if name.strip()]
        known = [patch.name for patch in self.patches]
        for name in wanted:
            if name not in known:
                raise BodyError(f"no patch {name!r} to start; there are {', '.join(known)}")
        return tuple(patch for patch in self.patches if patch.name in (wanted or known))


def read_body(path: Path) -> Body:
    """The body that a file describes; parameter files are read, too, those of layouts are not.

    Raises BodyError, naming file and line, for what no driver could be started with, and where two
    patches are after the same port, the same digitizer or the same tf frame.
    """
    content = read_marked(path, BodyError).mapping("the body")
    content.check_keys(_KEYS)
    frame = content.get("frame_id")
    frame_id = _frame(frame, "frame_id") if frame else "body"
    entries = content["patches"].mapping("patches").entries
    if not 1 <= len(entries) <= MOST_PATCHES:
        raise content["patches"].refuse(
            f"patches has {len(entries)} entries; 1…{MOST_PATCHES} are possible"
        )
    patches = [_patch(name, value, frame_id) for name, value in entries.items()]
    _check_apart(patches, entries)
    return Body(frame_id, tuple(patches))


def _patch(name: str, value: Marked, body_frame: str) -> Patch:
    if not _NAME.fullmatch(name):
        raise value.refuse(
            f"patch {name!r}: its name becomes a namespace, so it must be a letter and then "
            "letters, digits or _"
        )
    content = value.mapping(f"patch {name!r}")
    content.check_keys(_PATCH_KEYS)
    params, given = content.get("params_file"), content.get("parameters")
    params_file = _path(params, params.text("params_file")) if params else None
    if params and params_file:
        _file_values(params, params_file)
    parameters = _parameters(given.mapping(f"parameters of {name!r}")) if given else {}
    if not parameters.keys().isdisjoint(_MOUNTS):
        parameters.setdefault("parent_frame", body_frame)
    return Patch(name, params_file, {"frame_id": name, **parameters})


def _file_values(params: Marked, path: Path) -> Mapping[str, Value]:
    """What a parameter file says."""
    try:
        return read_file(path)
    except ParameterError as error:
        raise params.refuse(str(error)) from None


def _parameters(content: Keys) -> dict[str, Value]:
    """Values in their parameters' types."""
    values = {}
    for name, value in content.entries.items():
        if name not in BY_NAME:
            raise value.refuse(unknown(name, BY_NAME))
        values[name] = _value(BY_NAME[name], value)
    return values


def _value(parameter: Parameter, value: Marked) -> Value:
    kind, name = type(parameter.default), parameter.name
    read: Any = _TYPES[kind](value, name)
    if name in _FILES and read:
        read = str(_path(value, read))
    try:
        return parameter.check(read)
    except ParameterError as error:
        raise value.refuse(str(error)) from None


def _boolean(value: Marked, name: str) -> bool:
    text = value.text(name).lower()
    if text not in ("true", "false") or value.quoted:
        raise value.refuse(f"{name} is {value.content!r}; it must be true or false")
    return text == "true"


def _text(value: Marked, name: str) -> str:
    return "" if value.content == "" and value.quoted else value.text(name)


def _number(value: Marked, name: str) -> float:
    return value.number(name, -_ANY, _ANY)


def _numbers(value: Marked, name: str) -> tuple[float, ...]:
    return tuple(_number(item, f"a value of {name}") for item in value.items(name))


_ANY = 10**18
"""Limits are the parameter's business."""
_TYPES: dict[type, Callable[[Marked, str], Any]] = {
    bool: _boolean,
    int: lambda value, name: value.whole(name, -_ANY, _ANY),
    float: _number,
    str: _text,
    tuple: _numbers,
}


def _path(value: Marked, text: str) -> Path:
    """A path of the file's, from its folder or the home folder (~) on."""
    try:
        return (value.origin.path.parent / expanded(text)).absolute()
    except ValueError as error:
        raise value.refuse(f"{text}: {error}") from None


def _frame(value: Marked, what: str) -> str:
    frame_id = value.text(what)
    if frame_id.startswith("/"):
        raise value.refuse(f"{what} is {frame_id!r}; names of tf frames begin without a /")
    return frame_id


def _check_apart(patches: list[Patch], entries: Mapping[str, Marked]) -> None:
    """Whether each patch has a port, a digitizer and a tf frame of its own."""
    taken: dict[tuple[str, Value], str] = {}
    for patch in patches:
        try:
            own = _own(patch)
        except ParameterError as error:
            raise entries[patch.name].refuse(f"patch {patch.name!r}: {error}") from None
        for what, value in own:
            other = taken.setdefault((what, value), patch.name)
            if other != patch.name:
                raise entries[patch.name].refuse(
                    f"patch {patch.name!r} has {what} {value!r}, and so has {other!r}: "
                    "each patch needs its own"
                )


def _own(patch: Patch) -> list[tuple[str, Value]]:
    """What no other patch may have, as (parameter, value); raises ParameterError for a wrong id."""
    values = {name: parameter.default for name, parameter in BY_NAME.items()}
    values |= read_file(patch.params_file) if patch.params_file else {}
    values |= patch.parameters
    own = []
    if not str(values["port"]).startswith(SHARED_PORTS):
        own.append(("port", values["port"]))
    if values["digitizer_id"]:
        own.append(("digitizer_id", shown_id(parse_id(str(values["digitizer_id"])))))
    if values["skin"]:
        own.append(("skin", values["skin"]))
    if values["parent_frame"]:
        own.append(("frame_id", values["frame_id"]))
    return own
