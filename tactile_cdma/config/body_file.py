# SPDX-License-Identifier: Apache-2.0

"""Reads body files: YAML → the patches of one body, with the parameters of each patch's driver.

docs/patches.md describes the format.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ..base.errors import BodyError, ParameterError
from ..base.marked_yaml import Keys, Marked, read_marked
from ..base.named_file import existing, expanded
from ..wire.identity import parse_id, shown_id
from .parameters import DEFAULTS, REPLAY, SIMULATION, Value, Values, check_marked, read_file

NODE_NAME = "skin"
"""Name of a driver node unless it is renamed; a body's drivers are in namespaces by patch."""
MOST_PATCHES = 1000
"""Chosen, far above any robot's number of patches."""
SHARED_PORTS = (SIMULATION, REPLAY)
"""Prefixes of ports that any number of drivers can open."""
_NAME = re.compile("[A-Za-z][A-Za-z0-9_]*")
_KEYS = ("frame_id", "patches")
_PATCH_KEYS = ("params_file", "parameters")
_FILES = ("layout_file", "calibration_file", "state_folder")
"""Parameters that are paths; in a body file they are relative to its folder."""
_MOUNTS = ("mount_xyz_m", "mount_rpy_rad")


@dataclass(frozen=True, slots=True)
class Patch:
    """One driver.

    params_file: its ROS 2 parameter file; None: none. parameters: override that file; they always
    include frame_id. values: both.
    """

    name: str
    params_file: Path | None
    parameters: Mapping[str, Value]
    values: Mapping[str, Value]

    @property
    def node(self) -> str:
        """Fully qualified name of the driver's node."""
        return f"/{self.name}/{NODE_NAME}"


@dataclass(frozen=True, slots=True)
class Body:
    """The patches of a body, in the order of the file. frame_id: tf frame of the whole body."""

    frame_id: str
    patches: tuple[Patch, ...]

    def only(self, names: str) -> tuple[Patch, ...]:
        """The patches with these comma-separated names; all for an empty text.

        Raises BodyError for a name that no patch has.
        """
        wanted = [name.strip() for name in names.split(",") if name.strip()]
        known = [patch.name for patch in self.patches]
        for name in wanted:
            if name not in known:
                raise BodyError(f"no patch {name!r} to start; there are {', '.join(known)}")
        return tuple(patch for patch in self.patches if patch.name in (wanted or known))


def read_body(path: Path) -> Body:
    """Read a body file and the parameter files that it names, but not their layouts.

    Raises BodyError, naming file and line, for parameters that no driver can start with, and where
    two patches claim the same port, digitizer, skin or tf frame.
    """
    content = read_marked(path, BodyError).mapping("the body")
    content.check_keys(_KEYS)
    frame_id = content.text("frame_id", "body")
    if frame_id.startswith("/"):
        raise content["frame_id"].refuse(
            f"frame_id is {frame_id!r}; names of tf frames begin without a /"
        )
    entries = content["patches"].mapping("patches").entries
    if not 1 <= len(entries) <= MOST_PATCHES:
        raise content["patches"].refuse(
            f"patches has {len(entries)} entries; it must have 1…{MOST_PATCHES}"
        )
    taken: dict[tuple[str, str], str] = {}
    patches = tuple(_patch(name, value, frame_id, taken) for name, value in entries.items())
    return Body(frame_id, patches)


def _patch(name: str, value: Marked, body_frame: str, taken: dict[tuple[str, str], str]) -> Patch:
    """One patch. taken: the (parameter, value) pairs that earlier patches claim, by patch name."""
    if not _NAME.fullmatch(name):
        raise value.refuse(
            f"patch {name!r}: its name becomes a namespace, so it must be a letter and then "
            "letters, digits or _"
        )
    content = value.mapping(f"patch {name!r}")
    content.check_keys(_PATCH_KEYS)
    values, params_file, parameters = dict[str, Value](), None, dict[str, Value]()
    if params := content.get("params_file"):
        params_file = _path(params, params.text("params_file"))
        try:
            existing(params_file)
            values = read_file(params_file, f"/{name}/{NODE_NAME}")
        except ParameterError as error:
            raise params.refuse(str(error)) from None
    if given := content.get("parameters"):
        parameters = _parameters(given.mapping(f"parameters of {name!r}"))
    if not parameters.keys().isdisjoint(_MOUNTS):
        parameters.setdefault("parent_frame", body_frame)
    parameters = {"frame_id": name, **parameters}
    try:
        claims = _claims({**DEFAULTS, **values, **parameters})
    except ParameterError as error:
        raise value.refuse(f"patch {name!r}: {error}") from None
    for claim in claims:
        if (other := taken.setdefault(claim, name)) != name:
            raise value.refuse(
                f"patch {name!r} has {claim[0]} {claim[1]!r}, and so has {other!r}: each patch "
                "needs its own"
            )
    return Patch(name, params_file, parameters, values | parameters)


def _parameters(content: Keys) -> dict[str, Value]:
    """Values in their parameters' types, paths made absolute."""
    values = {}
    for name, value in content.entries.items():
        if isinstance(DEFAULTS.get(name), str) and not value.is_null:
            value = replace(value, quoted=True)  # skin: 7 is a name here, not a number
        read = check_marked(name, value)
        values[name] = str(_path(value, str(read))) if name in _FILES and read else read
    return values


def _path(value: Marked, text: str) -> Path:
    """A path relative to the file's folder or, with ~, the home folder."""
    try:
        return (value.file.path.parent / expanded(text)).absolute()
    except ValueError as error:
        raise value.refuse(f"{text}: {error}") from None


def _claims(values: Values) -> list[tuple[str, str]]:
    """Parameters whose value no other patch may have; raises ParameterError for a wrong id."""
    port, digitizer_id = values["port"], values["digitizer_id"]
    claims = {
        "port": "" if port.startswith(SHARED_PORTS) else port,
        "digitizer_id": digitizer_id and shown_id(parse_id(digitizer_id)),
        "skin": values["skin"],
        "frame_id": values["parent_frame"] and values["frame_id"],
    }
    return [(name, value) for name, value in claims.items() if value]
