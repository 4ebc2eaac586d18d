"""Tare and drift of a skin ↔ YAML file, so that they outlive the driver."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from .errors import RestError

SCHEMA = "tactile_cdma/rest"
VERSION = 1
MOST_BYTES = 4 << 20
"""65,535 nodes take 1.5 MB."""
_DIGITS = 8
"""Decimals of V that are kept."""
_MOST_V = 100.0
_SUFFIX = ".rest.yaml"
_HEAD = "# Written by the driver: what it takes off readings. Delete it to start anew.\n"


@dataclass(frozen=True, eq=False)
class RestState:
    """What a skin was found to read at rest.

    skin: its name; may be empty. nodes: on the wire. calibration: identity of the calibration,
    empty for the default one; for people. curves: checksum of its curves; tare and drift mean
    nothing without them.
    written: when, in ISO 8601. tared: when the tare was taken; empty: never, or not known.
    rest_v, drift_v: (n,) float32, see Baseline; None: no tare, no drift.
    """

    skin: str
    nodes: int
    calibration: str
    curves: str
    written: str
    tared: str
    rest_v: NDArray[np.float32] | None
    drift_v: NDArray[np.float32] | None

    def misfit(self, skin: str, nodes: int, curves: str) -> str | None:
        """Why this is not for such a skin, or None. A skin without a name is any."""
        if self.skin and skin and self.skin != skin:
            return f"it is of skin {self.skin!r}, this is {skin!r}"
        if self.nodes != nodes:
            return f"it is of a skin of {self.nodes} nodes, this one has {nodes}"
        if self.curves != curves:
            return (
                f"it goes with other curves (calibration {self.calibration or 'by default'}): "
                "tare again while nothing touches the skin"
            )
        return None


def rest_path(folder: str, node: str) -> Path:
    """The file of a ROS node, by its fully qualified name.

    folder: may begin with ~; empty: $ROS_HOME/tactile_cdma, or ~/.ros/tactile_cdma.
    Raises RestError where ~ is of a user that there is not.
    """
    parent = Path(folder or Path(os.environ.get("ROS_HOME") or "~/.ros", "tactile_cdma"))
    try:
        parent = parent.expanduser()
    except RuntimeError:
        raise RestError(f"no folder for tare and drift: {parent}: no such user's home") from None
    return parent / f"{node.strip('/').replace('/', '.')}{_SUFFIX}"


def calibration_path(rest: Path) -> Path:
    """Beside a node's file, that of the calibration it was found with."""
    return rest.with_name(rest.name.removesuffix(_SUFFIX) + ".calibration.yaml")


def write_rest(path: Path, state: RestState) -> None:
    """Replace the file at once, or not at all; makes its folder.

    Raises RestError where that is not possible.
    """
    content = {
        "schema": SCHEMA,
        "version": VERSION,
        "written": state.written,
        "skin": state.skin,
        "nodes": state.nodes,
        "calibration": state.calibration,
        "curves": state.curves,
        "tared": state.tared,
        "rest_v": _numbers(state.rest_v),
        "drift_v": _numbers(state.drift_v),
    }
    text = _HEAD + yaml.dump(content, Dumper=_DUMPER, sort_keys=False, allow_unicode=True)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())  # else a power cut may leave the new name on nothing
            os.replace(name, path)
        except BaseException:
            with suppress(OSError):
                os.unlink(name)
            raise
    except OSError as error:
        raise RestError(f"{path}: tare and drift are not kept: {error.strerror}") from None


def set_aside(path: Path) -> Path | None:
    """Rename a file that is not to be overwritten; its new name, or None where there is none.

    Raises RestError where that is not possible.
    """
    aside = path.with_name(f"{path.name}.old")
    try:
        os.replace(path, aside)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise RestError(f"{path}: cannot be set aside: {error.strerror}") from None
    return aside


def read_rest(path: Path) -> RestState | None:
    """What is in a file; None where there is none.

    Raises RestError, naming the file and the cause, for anything that is not such a file.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise RestError(f"{path}: larger than {MOST_BYTES >> 20} MB; is it something else?")
        text = data.decode("utf-8")
        _check_plain(text)
        content = yaml.load(text, Loader=_LOADER)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RestError(f"{path}: {error.strerror}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise RestError(f"{path}: not a YAML file: {' '.join(str(error).split())}") from None
    try:
        return _state(content)
    except RestError as error:
        raise RestError(f"{path}: {error}") from None


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # 10 times as quick, where it is built in


def _check_plain(text: str) -> None:
    """Raises YAMLError for deep nesting, with which the loader in C ends the whole process.

    And for aliases, with which a few lines make lists that no memory holds once they are shown.
    """
    depth = 0
    for event in yaml.parse(text, Loader=_LOADER):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not taken here")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEPTH:
            raise yaml.YAMLError(f"nested deeper than {_DEPTH} levels")


_DEPTH = 2


def _state(content: object) -> RestState:
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise RestError(f"not a file of tare and drift: its schema is not {SCHEMA}")
    if content.get("version") != VERSION:
        raise RestError(
            f"it has version {content.get('version')!r}, this driver reads {VERSION}: was it "
            "written by another driver?"
        )
    nodes = _field(content, "nodes", int)
    return RestState(
        skin=_field(content, "skin", str),
        nodes=nodes,
        calibration=_field(content, "calibration", str),
        curves=_field(content, "curves", str),
        written=_field(content, "written", str),
        tared=_field(content, "tared", str),
        rest_v=_array(content, "rest_v", nodes),
        drift_v=_array(content, "drift_v", nodes),
    )


def _field(content: dict[str, Any], name: str, kind: type) -> Any:
    value = content.get(name)
    if type(value) is not kind:
        raise RestError(f"{name} is {value!r}; it must be {_KIND_NAMES[kind]}")
    return value


_KIND_NAMES = {int: "an integer", str: "a text"}


def _array(content: dict[str, Any], name: str, nodes: int) -> NDArray[np.float32] | None:
    values = content.get(name)
    if values is None:
        return None
    if not isinstance(values, list) or len(values) != nodes:
        raise RestError(f"{name} must hold a number for each of {nodes} nodes, or null")
    for number, value in enumerate(values, start=1):
        if type(value) not in (int, float) or not -_MOST_V <= value <= _MOST_V:
            raise RestError(
                f"{name} of node {number} is {value!r}; it must be a number within ±{_MOST_V:g}"
            )
    return np.array(values, dtype=np.float32)


def _numbers(values: NDArray[np.float32] | None) -> list[float] | None:
    return None if values is None else np.round(values.astype(np.float64), _DIGITS).tolist()
