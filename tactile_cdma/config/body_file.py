# SPDX-License-Identifier: Apache-2.0

"""Reads body files: YAML → the patches of one body, with the parameters of each patch's driver.

docs/patches.md describes the format.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote, unquote

from ..base.errors import BodyError, ParameterError
from ..base.marked_yaml import MOST_BYTES, Keys, Marked, read_marked
from ..base.named_file import existing, expanded
from ..wire.identity import parse_id, shown_id
from .parameters import (
    DEFAULTS,
    REPLAY,
    SIMULATION,
    Parameter,
    Value,
    Values,
    check_marked,
    read_file,
)

NODE_NAME = "skin"
"""Name of a driver node unless it is renamed; a body's drivers are in namespaces by patch."""
MOST_PATCHES = 1000
"""Most patches of a body. Chosen, far above any robot's."""
MOST_VALUES = 1 << 18
"""Most values that `repeat` writes out: 262 for each of so many patches."""
RANGE, LOCALHOST = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
"""The environment variable that says how far processes look for each other, and a value of it."""
MOST_PROCESSES, MOST_LOCAL = 90, 28
"""Processes of patches on a computer, so that all find each other: rmw_fastrtps_cpp looks at 32
ports where RANGE is LOCALHOST, as rmw_cyclonedds_cpp does, and has 100 for each domain otherwise
(mutation_tries), of which the body's node, viewers and tools need some."""
SHARED_PORTS = (SIMULATION, REPLAY)
"""Prefixes of ports that any number of drivers can open."""
_NAME = re.compile("[A-Za-z][A-Za-z0-9_]*")
STALE_AFTER_S = 1.0
"""A patch that is silent for longer, s, is absent from a body, unless it is told otherwise. Chosen:
above what a busy computer holds frames back, and the period of `idle_rate_hz`."""
STALE_LIMITS_S = (0.05, 86_400.0)
"""The shortest and the longest that can be told, s; chosen: four frames, and a day."""
STALE_AFTER = Parameter(
    "stale_after_s", STALE_AFTER_S, "a patch silent for longer is absent", "s", STALE_LIMITS_S
)
"""A parameter of the body's node, and a key of its file."""
_KEYS = ("frame_id", "frame_prefix", STALE_AFTER.name, "process", "defaults", "patches")
_DEFAULT_KEYS = ("params_file", "parameters")
_PATCH_KEYS = (*_DEFAULT_KEYS, "repeat")
ONE, PER_PATCH = "one", "per_patch"
"""Values of `process`, besides processes with their patches."""
ITEM = "{}"
"""Stands for an item of `repeat`, in the name of a patch and in its texts."""
_FILES = ("layout_file", "calibration_file", "state_folder")
"""Parameters that are paths; in a body file they are relative to its folder."""
_PATHS_IN_PORTS = {
    "replay": re.compile("(?<=^replay://)[^?]+", re.IGNORECASE),
    "sim": re.compile("(?<=[?&]layout=)[^&]+"),
}
"""The paths in ports, by their schemes."""
_MOUNTS = ("mount_xyz_m", "mount_rpy_rad")
_FRAMES = ("frame_id", "parent_frame")


@dataclass(frozen=True, slots=True)
class Patch:
    """One driver.

    params_file: its ROS 2 parameter file; None: none. parameters: override that file; they always
    include frame_id. values: both. within: namespace of the body, /robot1, or empty.
    """

    name: str
    params_file: Path | None
    parameters: Mapping[str, Value]
    values: Mapping[str, Value]
    within: str = ""

    @property
    def namespace(self) -> str:
        """Return the namespace of the driver's node, from the root on."""
        return f"{self.within}/{self.name}"

    @property
    def node(self) -> str:
        """Return the fully qualified name of the driver's node."""
        return f"{self.namespace}/{NODE_NAME}"


@dataclass(frozen=True, slots=True)
class Body:
    """The patches of a body, in the order of the file. frame_id: tf frame of the whole body.

    within: namespace of all its nodes, /robot1, or empty. stale_after_s: a patch that is silent for
    longer is absent. shared: names of the patches that share a process, process by process.
    """

    frame_id: str
    patches: tuple[Patch, ...]
    within: str
    stale_after_s: float
    shared: tuple[tuple[str, ...], ...] = ()

    def processes(self, names: str = "") -> list[tuple[Patch, ...]]:
        """Divide the patches that only(names) selects among processes.

        Raises BodyError, too, for more than DDS lets find each other on a computer.
        """
        patches = self.only(names)
        shared = [tuple(patch for patch in patches if patch.name in group) for group in self.shared]
        together = {name for group in self.shared for name in group}
        found = [*filter(None, shared), *((p,) for p in patches if p.name not in together)]
        is_local = os.environ.get(RANGE, "").upper() == LOCALHOST
        if len(found) > (most := MOST_LOCAL if is_local else MOST_PROCESSES):
            where = f" with {RANGE}={LOCALHOST}" if is_local else ""
            raise BodyError(
                f"{len(found)} processes of patches; DDS lets no more than {most} on a computer "
                f"find all others{where}: let patches share processes, as by process: one"
            )
        return found

    def only(self, names: str) -> tuple[Patch, ...]:
        """Select the patches with these comma-separated names; all for an empty text.

        Raises BodyError for a name that no patch has.
        """
        wanted = [name.strip() for name in names.split(",") if name.strip()]
        known = [patch.name for patch in self.patches]
        for name in wanted:
            if name not in known:
                raise BodyError(f"no patch {name!r} to start; there are {', '.join(known)}")
        return tuple(patch for patch in self.patches if patch.name in (wanted or known))


def full_name(patch: str) -> str:
    """Complete the name of a driver: left_palm and /left_palm/skin are the same patch."""
    name = patch.strip("/")
    return f"/{name}" if name == NODE_NAME or "/" in patch else f"/{name}/{NODE_NAME}"


def short_name(node: str) -> str:
    """Return the patch's name in the body file: left_palm of /left_palm/skin."""
    return node.strip("/").removesuffix(f"/{NODE_NAME}")


def read_body(path: Path, namespace: str = "") -> Body:
    """Read a body file and the parameter files that it names, but not their layouts.

    namespace: of the body's nodes; names of tf frames begin with it, too, unless the file has a
    frame_prefix, so that several robots can share the file.

    Raises BodyError, naming file and line, for parameters that no driver can start with, and where
    two patches claim the same port, digitizer, skin or tf frame.
    """
    content = read_marked(path, BodyError).mapping("the body")
    content.check_keys(_KEYS)
    for key in ("frame_id", "frame_prefix"):
        if (text := content.text(key, "")).startswith("/"):
            raise content[key].refuse(f"{key} is {text!r}; names of tf frames begin without a /")
    within = f"/{name}" if (name := namespace.strip("/")) else ""
    frame_id = content.text("frame_id", "body")
    prefix = content.text("frame_prefix", f"{within}/"[1:])
    stale_after_s = STALE_AFTER_S
    if given := content.get(STALE_AFTER.name):
        stale_after_s = given.number(STALE_AFTER.name, *STALE_LIMITS_S, "s")
    defaults = dict[str, Marked]()
    if given := content.get("defaults"):
        keys = given.mapping("defaults")
        keys.check_keys(_DEFAULT_KEYS)
        defaults = keys.entries
    entries = _repeated(content["patches"].mapping("patches"), defaults)
    if not 1 <= len(entries) <= MOST_PATCHES:
        raise content["patches"].refuse(
            f"patches has {len(entries)} entries; it must have 1…{MOST_PATCHES}"
        )
    taken: dict[tuple[str, str], str] = {}
    about = (within, prefix), frame_id, taken
    patches = tuple(_patch(name, _over(value, defaults), *about) for name, value in entries.items())
    shared = _shared(content, list(entries))
    return Body(prefix + frame_id, patches, within, stale_after_s, shared)


def _shared(content: Keys, names: list[str]) -> tuple[tuple[str, ...], ...]:
    """Names of the patches that share a process, by `process`."""
    if (value := content.get("process")) is None or value.content == PER_PATCH:
        return ()
    if value.content == ONE:
        return (tuple(names),)
    if isinstance(value.content, str):
        raise value.refuse(
            f"process is {value.content[:40]!r}; it must be {ONE}, {PER_PATCH}, or processes with "
            "lists of their patches"
        )
    groups, taken = [], set[str]()
    for process, entry in value.mapping("process").entries.items():
        group = [name.text("a patch") for name in entry.items(f"process {process!r}", least=1)]
        for name in group:
            if name not in names or name in taken:
                wrong = "is in two processes" if name in names else "is no patch"
                raise entry.refuse(f"process {process!r}: {name!r} {wrong}")
            taken.add(name)
        groups.append(tuple(group))
    return tuple(groups)


def _repeated(content: Keys, defaults: dict[str, Marked]) -> dict[str, Marked]:
    """Write out the patches with `repeat`, over the defaults; returns all by name."""
    found: dict[str, Marked] = {}
    room = {"values": MOST_VALUES, "characters": MOST_BYTES}
    for name, value in content.entries.items():
        keys = value.content if isinstance(value.content, dict) else {}
        if (repeat := keys.get("repeat")) is None:
            found[name] = value
            continue
        rest = replace(value, content={key: one for key, one in keys.items() if key != "repeat"})
        if isinstance(repeat.content, dict):  # with parameters of each
            own = {item: {"parameters": given} for item, given in repeat.content.items()}
            if len(own) > MOST_PATCHES:
                raise repeat.refuse(f"repeat has {len(own)} items; the limit is {MOST_PATCHES}")
        else:
            items = [item.text("an item") for item in repeat.items("repeat", 1, MOST_PATCHES)]
            own = {item: {} for item in items}
            if len(own) < len(items):
                raise repeat.refuse("repeat has an item twice")
        if ITEM not in name:
            raise value.refuse(f"patch {name!r} is repeated: its name must have {ITEM} for an item")
        for item, given in own.items():
            each = str(_filled(replace(value, content=name), item, room).content)
            if each in found or each in content.entries:
                raise repeat.refuse(f"repeat makes another patch {each!r}")
            merged = _over(_over(replace(rest, content=given), rest.content), defaults)
            found[each] = _filled(merged, item, room)
    return found


def _filled(value: Marked, item: str, room: dict[str, int]) -> Marked:
    """Return a value with an item of `repeat` in its texts. room: what may still be written out."""
    text = value.content if isinstance(value.content, str) else ""
    longer = text.count(ITEM) * (len(item) - len(ITEM))
    room["values"] -= 1
    room["characters"] -= longer
    if min(room.values()) < 0:
        raise value.refuse(
            f"repeat writes out more than {MOST_VALUES} values, or {MOST_BYTES} characters"
        )
    if isinstance(value.content, str):
        return replace(value, content=text.replace(ITEM, item)) if longer or ITEM in text else value
    if isinstance(value.content, dict):
        return replace(value, content={k: _filled(v, item, room) for k, v in value.content.items()})
    return replace(value, content=[_filled(one, item, room) for one in value.content])


def _over(value: Marked, defaults: object) -> Marked:
    """Lay a patch's keys over the defaults': parameter by parameter, else as a whole."""
    own: object = {} if value.is_null else value.content
    if not (isinstance(defaults, dict) and defaults and isinstance(own, dict)):
        return value
    merged = {**defaults, **own}
    below, above = (keys.get("parameters") for keys in (defaults, own))
    if below and above and isinstance(below.content, dict) and isinstance(above.content, dict):
        merged["parameters"] = replace(above, content={**below.content, **above.content})
    return replace(value, content=merged)


def _patch(
    name: str,
    value: Marked,
    around: tuple[str, str],
    body_frame: str,
    taken: dict[tuple[str, str], str],
) -> Patch:
    """Read one patch.

    around: namespace, and what tf frames begin with; body_frame is without it. taken: the
    (parameter, value) pairs that earlier patches claim, by name.
    """
    within, prefix = around
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
        with params.refusing(ParameterError):
            existing(params_file)
            values = read_file(params_file, f"{within}/{name}/{NODE_NAME}")
    if given := content.get("parameters"):
        parameters = _parameters(given.mapping(f"parameters of {name!r}"))
    if not parameters.keys().isdisjoint(_MOUNTS):
        parameters.setdefault("parent_frame", body_frame)
    parameters = {"frame_id": name, **parameters}
    frames = {key: (values | parameters).get(key) for key in _FRAMES}
    parameters |= {key: f"{prefix}{frame}" for key, frame in frames.items() if frame and prefix}
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
    return Patch(name, params_file, parameters, values | parameters, within)


def _parameters(content: Keys) -> dict[str, Value]:
    """Return values in their parameters' types, paths made absolute."""
    values = {}
    for name, value in content.entries.items():
        if isinstance(DEFAULTS.get(name), str) and not value.is_null:
            value = replace(value, quoted=True)  # skin: 7 is a name here, not a number
        read = check_marked(name, value)
        if name in _FILES and read:
            read = str(_path(value, str(read)))
        values[name] = _rooted(value, str(read)) if name == "port" else read
    return values


def _rooted(value: Marked, port: str) -> str:
    """Make the path in a port, of a recording or a simulated skin's layout, absolute."""

    def absolute(path: re.Match[str]) -> str:
        return quote(str(_path(value, unquote(path[0]))))

    where = _PATHS_IN_PORTS.get(port.partition("://")[0].lower())
    return where.sub(absolute, port) if where else port


def _path(value: Marked, text: str) -> Path:
    """Make a path absolute: relative to the file's folder or, with ~, the home folder."""
    try:
        return (value.file.path.parent / expanded(text)).absolute()
    except ValueError as error:
        raise value.refuse(f"{text}: {error}") from None


def _claims(values: Values) -> list[tuple[str, str]]:
    """Return parameters whose values are this patch's only; raises ParameterError for bad ids."""
    port, digitizer_id = values["port"], values["digitizer_id"]
    claims = {
        "port": "" if port.lower().startswith(SHARED_PORTS) else port,
        "digitizer_id": digitizer_id and shown_id(parse_id(digitizer_id)),
        "skin": values["skin"],
        "frame_id": values["parent_frame"] and values["frame_id"],
    }
    return [(name, value) for name, value in claims.items() if value]
